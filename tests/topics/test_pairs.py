# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Scaling out, real time and cores of one's own: over real topics, with limits."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest

from benchmarks.processes import bench
from pdeloop.in_process import LocalPair, train
from pdeloop.training_run import resolve
from tests.support.hosts import can_make_hosts, hosts
from tests.support.interpreter import helps_solver
from tests.support.loop_harness import Processes, until
from tests.support.pairs_on_hosts import serve
from tests.support.small import SMALL, parameters, train_here
from tests.support.small_loop import LIMIT, adapted, assert_same_training
from tuner_node.build import build_training

pytestmark = pytest.mark.topics


def _hosts_work() -> bool:
    if not can_make_hosts():
        return False
    try:
        with hosts(1):
            return True
    except RuntimeError:
        return False


def test_pairs_on_hosts_with_faults_one_of_them_killed_give_the_same_bits() -> None:
    if not _hosts_work():  # asked here, and not in every worker that collects the tests
        pytest.skip("needs root, iproute2, and a kernel with veth")
    values = resolve(str(SMALL), {"iterations": 12, "seeds": 4, "evaluation_fields": 2})
    training = build_training(values)
    train(training, LocalPair(values), lambda row: None)
    row = serve(values, 2, ["loss:=0.01", "delay:=0.001"], kill=True, expected=training.policies())
    assert row["identical"]
    assert row["seconds"] < LIMIT


def test_the_command_line_starts_pairs(loop: Processes, tmp_path) -> None:
    options = {"optimizer": "two_point", "iterations": 3, "seeds": 4}
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    out = tmp_path / "run"
    loop.wait(loop.pdeloop("train", str(SMALL), *words, "--pairs", "2", "--out", str(out)), LIMIT)
    assert_same_training(out, train_here(parameters(**options)))
    assert len(json.loads((out / "result.json").read_text())["history"]) == 3 * 4


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_plant_and_controller_share_a_core(loop, tmp_path) -> None:
    options = ("--optimizer", "two_point", "--iterations", "100000", "--seeds", "5")
    run = loop.pdeloop("train", str(SMALL), *options, "--out", str(tmp_path / "a"))
    until(lambda: adapted(tmp_path / "a") >= 3, LIMIT, "iteration 3")
    free = {frozenset(os.sched_getaffinity(0))}

    def places(node: str) -> set[frozenset[int]]:
        return {
            frozenset(os.sched_getaffinity(int(thread.name)))
            for pid in loop.pids(node)
            for thread in Path(f"/proc/{pid}/task").iterdir()
            if not helps_solver(pid, int(thread.name))
        }

    plant, controller = places("pde_sim_node"), places("controller_node")
    assert plant == controller
    assert [len(cores) for cores in plant] == [1]
    assert places("tuner_node") == free
    run.send_signal(signal.SIGINT)
    loop.wait(run, LIMIT, code=130)


def test_a_node_refuses_a_core_that_is_not_there(loop: Processes) -> None:
    text = loop.wait(loop.node("controller_node", "-p", "pin:=4000"), LIMIT, code=1)
    assert "parameter 'pin' is 4000; expected -1 or one of the cores" in text


def test_the_processes_of_a_measurement_end_with_it() -> None:
    with bench() as running:
        node = running.start("benchmarks.ping", "end:=pong")
    assert node.process.poll() is not None
