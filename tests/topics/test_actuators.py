# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Actuators at unequal places, over topics: the training of one process, and a law that helps."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pdeloop.bags.verify import verify
from tests.support.loop_harness import Processes
from tests.support.small import FEW_STEPS, SMALL, parameters, train_here
from tests.support.small_loop import LIMIT, assert_same_training, start_tuner

pytestmark = pytest.mark.topics
POSITIONS = [0.05, 0.2, 0.45, 0.9]
OPTIONS = {"rollouts": 15, "optimizer": "model_based", **FEW_STEPS}


def test_a_training_by_the_command_line_is_recorded_and_recomputed(loop: Processes, tmp_path):
    out = tmp_path / "run"
    words = ["train", str(SMALL), "--rollouts", "15", "--optimizer", "model-based", "--record"]
    words += [word for name, value in FEW_STEPS.items() for word in ("--set", f"{name}={value}")]
    words += ["--actuator-positions", ",".join(map(str, POSITIONS)), "--actuator-shape", "gaussian"]
    loop.wait(loop.pdeloop(*words, "--out", str(out)), LIMIT)
    placed = {"actuator_positions": POSITIONS, "actuator_shape": "gaussian"}
    assert_same_training(out, train_here(parameters(**OPTIONS, **placed)))
    report = verify(out)
    assert (report.count, report.incomplete, report.notes) == (0, [], [])
    costs = json.loads((out / "result.json").read_text())["costs_by_field"]
    none, lqt, adapted = (np.mean(costs[name]) for name in ("none", "lqt", "adapted"))
    assert adapted < lqt < 0.9 * none


def test_nodes_by_hand_read_the_places_from_the_problems_file(loop: Processes, tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text(f"{SMALL.read_text()}    actuator_positions: {POSITIONS}\n")
    for name in ("pde_sim_node", "controller_node"):
        loop.node(name, "--params-file", str(own))
    out = tmp_path / "run"
    loop.wait(start_tuner(loop, out, "--params-file", str(own), **OPTIONS), LIMIT)
    placed = {"actuator_positions": POSITIONS}
    assert_same_training(out, train_here(parameters(**OPTIONS, **placed)))
