# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`model_based` with noise, action limits and sensors over topics: the training of one process."""

from __future__ import annotations

import signal
from typing import Any

import pytest

from pdeloop.bags.verify import verify
from pdeloop.training_run import resolve
from tests.support.loop_harness import Processes, until
from tests.support.small import FEW_STEPS, SMALL, parameters, train_here
from tests.support.small_loop import LIMIT, PARAMETERS, adapted, assert_same_training, start_tuner

pytestmark = pytest.mark.topics
HORIZON = 8
OWN: dict[str, Any] = {
    "measurement_noise": 0.02,
    "process_noise": 0.01,
    "action_limit": 0.8,
    "action_bounds": [-0.3, -1.0, 1.0, 0.5, 0.0],
    "sensors": 6,
    "sensor_delays": 1,
    # A problem so small that an update takes no time.
    "n_z": 16,
    "n_a": 2,
    "horizon": HORIZON,
    "reduced_order": 3,
    **FEW_STEPS,
}
WORDS = [word for name, value in OWN.items() for word in ("-p", f"{name}:={value}")]


def test_a_faulty_line_and_killed_nodes_change_no_noise(loop: Processes, tmp_path):
    out = tmp_path / "run"
    start = (*PARAMETERS, *WORDS)
    lines = {"pde_sim_node": "state:=state_sent", "controller_node": "action:=action_sent"}
    running = {name: loop.node(name, *start, "-r", line) for name, line in lines.items()}
    line = ("-p", "loss:=0.002", "-p", "duplicate:=0.2", "-p", "delay:=0.002")
    loop.start("-m", "tests.support.relay.node", "--ros-args", *line, name="relay")
    options = {"rollouts": 30, "optimizer": "model_based"}  # four batches
    tuner = start_tuner(loop, out, *WORDS, **options, max_attempts=50)
    for count, victim in ((1, "controller_node"), (2, "pde_sim_node")):
        until(lambda least=count: adapted(out) >= least, LIMIT, f"batch {count}")
        running[victim].send_signal(signal.SIGKILL)
        running[victim].wait()
        loop.node(victim, *start, "-r", lines[victim])
    until(lambda: adapted(out) >= 3, LIMIT, "batch 3")
    tuner.send_signal(signal.SIGKILL)
    tuner.wait()
    loop.wait(start_tuner(loop, out, *WORDS, **options, max_attempts=50, resume="true"), LIMIT)
    assert_same_training(out, train_here(parameters(**options, **OWN)))


def test_a_recorded_run_is_recomputed_with_its_noise(loop: Processes, tmp_path):
    """What trainings with few sensors fit otherwise is recomputed in test_extended_kalman."""
    own = tmp_path / "own.yaml"
    small = [x for x in SMALL.read_text().splitlines() if x.strip().split(":")[0] not in OWN]
    own.write_text("\n".join([*small, *(f"    {name}: {value}" for name, value in OWN.items())]))
    out = tmp_path / "run"
    words = (
        "train",
        str(own),
        "--rollouts",
        "12",
        "--record",
        "--optimizer",
        "model_based",
        "--law",
        "affine",
    )
    loop.wait(loop.pdeloop(*words, "--out", str(out)), LIMIT)
    report = verify(out)
    assert (report.count, report.incomplete, report.notes) == (0, [], [])
    assert report.compared["steps"] == HORIZON * report.compared["costs"]
    assert report.compared["policies"] >= 11  # all but the exploration
    given = {"rollouts": 12, "optimizer": "model_based", "law": "affine"}
    values = resolve(str(own), given)
    assert_same_training(out, train_here(values))
