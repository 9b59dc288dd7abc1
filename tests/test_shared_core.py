"""Which core a pair is on, and that its processes are moved there."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bringup.shared_core import SharedCores, freest, worthwhile

several = pytest.mark.skipif(
    len(os.sched_getaffinity(0)) < 2, reason="needs two cores to choose from"
)


def test_a_pair_leaves_its_core_only_for_one_that_is_clearly_freer():
    assert freest({0: 0.9, 1: 0.1}, present=0) == 1
    assert freest({0: 0.9, 1: 0.1}, present=1) == 1
    assert freest({0: 0.4, 1: 0.2}, present=0) == 0
    assert freest({0: 1.0, 1: 1.0, 2: 1.0}, present=2) == 2
    assert freest({0: 0.5, 3: 0.0, 5: 0.0}, present=5) == 5
    assert freest({0: 0.5, 3: 0.0, 5: 0.0}, present=0) == 3
    assert freest({0: 0.0, 1: 0.0}, present=7) == 0  # a core that this process may not use


@several
def test_large_batches_want_all_cores():
    assert worthwhile(2)
    assert worthwhile(8)
    assert not worthwhile(9)


def busy_process() -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", "while True: pass"])


@several
def test_processes_share_a_core_and_leave_it_to_who_needs_it():
    cores = SharedCores(1)
    started = [subprocess.Popen(["sleep", "60"]) for _ in range(2)]
    try:
        for process in started:
            cores.place(0, process.pid)
        (first,) = os.sched_getaffinity(started[0].pid)
        assert os.sched_getaffinity(started[1].pid) == {first}
        others = os.sched_getaffinity(0) - {first}
        crowd = [busy_process() for _ in range(2)]
        started += crowd
        for process in crowd:
            os.sched_setaffinity(process.pid, {first})
        deadline = time.monotonic() + 30.0
        now = 0.0
        while os.sched_getaffinity(started[0].pid) == {first}:
            assert time.monotonic() < deadline, "still on the crowded core after 30 s"
            cores.look(now)
            now += 10.0
            time.sleep(0.5)
        (second,) = os.sched_getaffinity(started[0].pid)
        assert second in others
        assert os.sched_getaffinity(started[1].pid) == {second}
    finally:
        for process in started:
            process.kill()
            process.wait()


def test_a_process_that_has_ended_is_nothing_to_move():
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    assert not Path(f"/proc/{ended.pid}").exists()
    cores = SharedCores(1)
    cores.place(0, ended.pid)
    cores.look(0.0)
    cores.look(10.0)
