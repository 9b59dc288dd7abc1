# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Noise that only the plant knows of, over topics: the find and the training of one process."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import pytest
import yaml

import pdeloop
from pde_sim_node.build import build_plant
from pdeloop.in_process import LocalPair, train
from pdeloop.messages.problem import config_folder
from tests.support.loop_harness import Processes, until
from tests.support.small_loop import LIMIT, assert_same_training
from tuner_node.build import build_training

pytestmark = pytest.mark.topics
QUICK: dict[str, Any] = {
    "n_z": 96,
    "n_a": 6,
    "horizon": 20,
    "reduced_order": 8,
    "rollouts": 6,
    "evaluation_fields": 1,
    "exploration_variance": 1.0,
    "identification": "regression",
    "field_model_settings": {"folds": 2, "largest_degree": 3},
    "optimizer_settings": {"iterations": 1},
}
SIGMA = 0.05


def problem_file(folder: Path) -> Path:
    """Four random modes of Allen-Cahn, of which a short training finds the noise."""
    known = yaml.safe_load((config_folder() / "problems" / "allen-cahn-modes.yaml").read_text())
    known["/**"]["ros__parameters"] |= QUICK
    path = folder / "noisy.yaml"
    path.write_text(yaml.safe_dump(known))
    return path


def test_a_tuner_that_is_killed_after_the_find_ends_with_the_same_bits(
    loop: Processes, tmp_path: Path
) -> None:
    path, out = problem_file(tmp_path), tmp_path / "run"
    noisy = pdeloop.problem(path, measurement_noise=SIGMA).values
    values = {**noisy, "measurement_noise": 0.0}
    expected = build_training(values)
    train(expected, LocalPair(values, build_plant(noisy)), lambda row: None)
    start = ("--params-file", str(path))
    loop.node("pde_sim_node", *start, "-p", f"measurement_noise:={SIGMA}")
    loop.node("controller_node", *start)
    tuner = loop.node("tuner_node", *start, "-p", f"out:={out}")
    until(lambda: '"noise"' in progress(out), LIMIT, "noise that was found")
    tuner.send_signal(signal.SIGKILL)
    tuner.wait()
    loop.wait(loop.node("tuner_node", *start, "-p", f"out:={out}", "-p", "resume:=true"), LIMIT)
    assert_same_training(out, expected)
    result = json.loads((out / "result.json").read_text())
    assert result["history"] == expected.history
    assert result["noise"]["found"] == [pytest.approx(SIGMA, rel=0.1)]


def progress(folder: Path) -> str:
    path = folder / "progress.jsonl"
    return path.read_text() if path.exists() else ""
