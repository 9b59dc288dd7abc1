# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Whatever happens to processes, messages and disks, the training ends with one policy."""

from __future__ import annotations

import os
import shutil
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest

from pdeloop.cli import main
from pdeloop.in_process import LocalPair
from tests.support.loop_harness import until
from tests.support.small import SMALL, paced
from tests.support.small_disk import small_disk
from tests.support.small_loop import (
    LIMIT,
    PARAMETERS,
    adapted,
    assert_same_training,
    in_process,
    start_pair,
    start_tuner,
)
from tuner_node.batch import Batch, BatchResult

pytestmark = pytest.mark.topics
STOPS_WHILE_IT_STARTS = """
import os, signal, sys
from pdeloop.ros.node_main import node_main
from pdeloop.ros import node_loop, observer

class Body:
    def __init__(self, node, loop):
        self.loop = loop
        os.kill(os.getpid(), signal.SIGSTOP)

    def join(self, node, loop):
        print("as a new participant", flush=True)
        loop.stop("done")
        self.loop = loop

    def run(self):
        {run}
        return 0

sys.exit(node_main("late", ["--ros-args"], Body, {loop}))
"""


def test_lost_repeated_delayed_and_reordered_messages_change_nothing(loop, tmp_path):
    faults = {"loss": 0.03, "duplicate": 0.2, "delay": 0.01}
    loop.node("pde_sim_node", *PARAMETERS, "-r", "state:=state_sent", "-p", "action_timeout:=0.02")
    loop.node("controller_node", *PARAMETERS, "-r", "action:=action_sent")
    arguments = [word for name, value in faults.items() for word in ("-p", f"{name}:={value}")]
    relay = loop.start("-m", "tests.support.relay.node", "--ros-args", *arguments, name="relay")
    tuner = start_tuner(loop, tmp_path / "run", iterations=8)
    loop.wait(tuner, LIMIT)
    assert_same_training(tmp_path / "run", in_process(iterations=8))
    relay.send_signal(signal.SIGINT)
    text = loop.wait(relay, LIMIT)
    assert " 0 lost" not in text
    assert " 0 duplicated" not in text


@pytest.mark.parametrize("victim", ["plant", "controller", "tuner"])
def test_a_stopped_process_that_goes_on_later_changes_nothing(loop, tmp_path, victim):
    # Stopped for longer than the action timeout, the void limit and the DDS lease of 4 s.
    running = start_pair(loop, max_repeats=20)
    out = tmp_path / "run"
    running["tuner"] = start_tuner(loop, out, iterations=60)
    until(lambda: adapted(out) >= 10, LIMIT, "iteration 10")
    running[victim].send_signal(signal.SIGSTOP)
    time.sleep(5.0)
    running[victim].send_signal(signal.SIGCONT)
    loop.wait(running["tuner"], LIMIT)
    assert_same_training(out, in_process(iterations=60))


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize(
    ("loop_class", "run"),
    [
        ("node_loop.NodeLoop", "self.loop.run(lambda now: None)"),
        ("observer.Observer", "self.loop.run()"),
    ],
)
def test_a_node_that_is_stopped_while_it_starts_joins_again_or_ends(loop, loop_class, run, ends):
    # Peers that have forgotten it, and that it still knows, may never find it again otherwise.
    node = loop.start("-c", STOPS_WHILE_IT_STARTS.format(loop=loop_class, run=run), name="late")
    state = Path(f"/proc/{node.pid}/stat")
    until(lambda: state.read_text().rpartition(")")[2].split()[0] == "T", LIMIT, "stop")
    time.sleep(2.5)
    if ends:
        node.send_signal(signal.SIGTERM)
    node.send_signal(signal.SIGCONT)
    assert ("as a new participant" in loop.wait(node, LIMIT)) != ends


def test_the_supervisor_restarts_what_dies_and_says_so(loop, tmp_path):
    out = tmp_path / "run"
    problem = str(paced(tmp_path, 50.0))  # 30 ms an episode
    run = loop.pdeloop("train", problem, "--iterations", "50", "--out", str(out))
    for count, name in ((5, "pde_sim_node"), (10, "controller_node"), (15, "tuner_node")):
        until(lambda n=count: adapted(out) >= n, LIMIT, f"iteration {count}")
        (pid,) = loop.pids(name)
        os.kill(pid, signal.SIGKILL)
    text = loop.wait(run, LIMIT)
    assert_same_training(out, in_process(iterations=50))
    for name in ("pde_sim_node", "controller_node", "tuner_node"):
        assert f"{name} was killed by SIGKILL; starting it again" in text


def test_everything_dies_at_once_and_the_run_continues(loop, tmp_path):
    out = tmp_path / "run"
    problem = str(paced(tmp_path, 50.0))  # 30 ms an episode
    run = loop.pdeloop("train", problem, "--iterations", "50", "--out", str(out))
    until(lambda: adapted(out) >= 10, LIMIT, "iteration 10")
    os.kill(run.pid, signal.SIGKILL)  # its children die with it
    until(lambda: loop.left_behind() == [], LIMIT, "end of the killed supervisor's nodes")
    run.wait()
    loop.wait(loop.pdeloop("train", "--resume", str(out)), LIMIT)
    assert_same_training(out, in_process(iterations=50))


def test_a_node_that_keeps_dying_is_given_up(loop, tmp_path):
    out = tmp_path / "run"
    run = loop.pdeloop("train", str(SMALL), "--iterations", "100000", "--out", str(out))
    killed: set[int] = set()
    deadline = time.monotonic() + LIMIT
    while run.poll() is None:
        assert time.monotonic() < deadline, "the supervisor goes on forever"
        for pid in set(loop.pids("controller_node")) - killed:
            os.kill(pid, signal.SIGKILL)
            killed.add(pid)
        time.sleep(0.05)
    text = loop.wait(run, LIMIT, code=1)
    assert "controller_node was killed by SIGKILL for the 6th time" in text
    assert len(killed) == 6


def test_a_new_run_is_not_disturbed_by_what_an_earlier_one_left_latched(loop, tmp_path):
    start_pair(loop, real_time_factor=20.0)
    first = start_tuner(loop, tmp_path / "first", iterations=100_000)
    until(lambda: adapted(tmp_path / "first") >= 1, LIMIT, "iteration 1")
    first.send_signal(signal.SIGSTOP)  # its start, policy and model stay on the network
    time.sleep(0.2)
    first.send_signal(signal.SIGINT)
    first.send_signal(signal.SIGCONT)
    loop.wait(first, LIMIT, code=130)
    second = start_tuner(loop, tmp_path / "second", seed=1)
    loop.wait(second, LIMIT)
    assert_same_training(tmp_path / "second", in_process(seed=1))


def fill(disk: Path) -> None:
    """Write until nothing more fits."""
    with (disk / "filler").open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(b"x" * 4096)


def test_a_full_disk_is_reported_and_the_training_goes_on(loop, tmp_path):
    start_pair(loop, real_time_factor=25.0)  # 60 ms an episode: it lasts longer than the full disk
    with small_disk(tmp_path / "disk", megabytes=8) as disk:
        out = disk / "run"
        tuner = start_tuner(loop, out, iterations=100)
        until(lambda: adapted(out) >= 5, LIMIT, "iteration 5")
        fill(disk)
        until(lambda: "cannot write the checkpoint" in loop.output(tuner), LIMIT, "warning")
        (disk / "filler").unlink()
        loop.wait(tuner, LIMIT)
        kept = shutil.copytree(out, tmp_path / "kept")
    assert_same_training(kept, in_process(iterations=100))


def test_a_full_disk_at_the_end_is_an_error_and_the_run_continues_later(
    tmp_path, monkeypatch, capsys
):
    ordinary = LocalPair.run

    def fill_while_it_evaluates(pair: LocalPair, batch: Batch, *how: int) -> BatchResult:
        if len(batch.rows) > 2:
            fill(disk)
        return ordinary(pair, batch, *how)

    with small_disk(tmp_path / "disk", megabytes=4) as disk:
        out = disk / "run"
        options = ["--in-process", "--iterations", "20", "--out", str(out)]
        with monkeypatch.context() as patch:
            patch.setattr(LocalPair, "run", fill_while_it_evaluates)
            assert main(["train", str(SMALL), *options]) == 1
        told = capsys.readouterr().err.strip().splitlines()
        assert "No space left on device" in told[-1]
        (disk / "filler").unlink()
        assert main(["train", "--resume", str(out), "--in-process"]) == 0
        kept = shutil.copytree(out, tmp_path / "kept")
    assert_same_training(kept, in_process())
