"""Scaling out, real time and cores of one's own: over real topics, with limits."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from benchmarks import pairs as bench_pairs
from benchmarks import realtime as bench_realtime
from benchmarks.hosts import can_make_hosts, hosts
from benchmarks.processes import bench
from loop_interfaces.affinity import helps_solver
from pdeloop.in_process import LocalPair, train
from pdeloop.training_run import resolve
from tests.loop_harness import Processes, until
from tests.small import SMALL, same_bits
from tests.topics.test_loop import LIMIT, assert_same_training, in_process, iterations_done
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


@pytest.mark.skipif(not _hosts_work(), reason="needs root, iproute2, and a kernel with veth")
def test_pairs_on_hosts_with_faults_one_of_them_killed_give_the_same_bits() -> None:
    values = resolve(str(SMALL), {"iterations": 12, "seeds": 4, "evaluation_fields": 2})
    training = build_training(values)
    train(training, LocalPair(values), lambda row: None)
    row = bench_pairs.serve(
        values, 2, ["loss:=0.01", "delay:=0.001"], kill=True, expected=training.policies()
    )
    assert row["identical"]
    assert row["seconds"] < LIMIT


def test_the_command_line_starts_pairs_and_directions(loop: Processes, tmp_path) -> None:
    arguments = ("train", str(SMALL), "--rollouts", "25", "--directions", "4", "--seeds", "2")
    over = loop.pdeloop(*arguments, "--pairs", "2", "--out", str(tmp_path / "a"))
    loop.wait(over, LIMIT)
    here = loop.pdeloop(*arguments, "--in-process", "--out", str(tmp_path / "b"))
    loop.wait(here, LIMIT)
    with np.load(tmp_path / "a/policy.npz") as a, np.load(tmp_path / "b/policy.npz") as b:
        assert same_bits(a["policy"], b["policy"])
    result = json.loads((tmp_path / "a" / "result.json").read_text())
    assert len(result["history"]) == 2 * 8 // 4


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_a_pinned_training_is_the_same(loop: Processes, tmp_path) -> None:
    run = loop.pdeloop(
        "train", str(SMALL), "--iterations", "6", "--pin", "--out", str(tmp_path / "a")
    )
    loop.wait(run, LIMIT)
    assert_same_training(tmp_path / "a", in_process(iterations=6))


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
@pytest.mark.parametrize("seeds", ["1", "5"])
def test_plant_and_controller_share_a_core(loop, tmp_path, seeds) -> None:
    options = ("--optimizer", "two_point", "--iterations", "100000", "--seeds", seeds)
    run = loop.pdeloop("train", str(SMALL), *options, "--out", str(tmp_path / "a"))
    until(lambda: iterations_done(tmp_path / "a") >= 3, LIMIT, "iteration 3")
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


def test_a_paced_plant_takes_as_long_as_the_wall_clock_says() -> None:
    result = bench_realtime.run(seconds=1.0, rates=(100.0,))
    (row,) = result["rows"]
    assert row["states"] == 100
    assert row["p50_us"] < 20_000


def test_the_processes_of_a_measurement_end_with_it() -> None:
    with bench() as running:
        node = running.start("benchmarks.ping", "end:=pong")
    assert node.process.poll() is not None
