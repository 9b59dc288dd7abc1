"""Which core a pair is on, and that its processes are moved there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pdeloop import core_affinity
from pdeloop.core_affinity import SharedCores, freest
from pdeloop.pairs import PAIR

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
def test_processes_share_a_core_and_leave_it_to_who_needs_it(monkeypatch, tmp_path):
    """Where the kernel's counts stand in a file of our own: real ones depend on who else runs."""
    counts = tmp_path / "stat"

    def taken(seconds: float, busy: set[int]) -> None:
        """Every core has idled for 1000 s; those in `busy` worked for so long, too."""
        worked = {core: 100 * seconds * (core in busy) for core in os.sched_getaffinity(0)}
        lines = [f"cpu{core} {ticks:.0f} 0 0 100000 0 0 0 0 0 0" for core, ticks in worked.items()]
        counts.write_text("\n".join(["cpu 1 2 3 4", *lines, "intr 5"]))

    monkeypatch.setattr(core_affinity, "_STAT", counts)
    cores = SharedCores(1)
    started = [subprocess.Popen(["sleep", "60"]) for _ in range(3)]
    try:
        cores.place(0, PAIR[0], started[0].pid)
        (first,) = os.sched_getaffinity(started[0].pid)
        cores.keep_away("recorder_node", started[2].pid)
        assert os.sched_getaffinity(started[2].pid) == os.sched_getaffinity(0) - {first}
        cores.place(0, PAIR[1], started[1].pid, started=0.0)  # loads what it needs on all cores
        taken(0.0, set())
        cores.look(0.9 * core_affinity.START_UP)
        assert os.sched_getaffinity(started[1].pid) == os.sched_getaffinity(0)
        cores.look(1.1 * core_affinity.START_UP)
        assert os.sched_getaffinity(started[1].pid) == {first}
        taken(1.0, set(os.sched_getaffinity(0)))
        cores.look(10.0)
        assert os.sched_getaffinity(started[0].pid) == {first}  # none is freer
        taken(9.0, {first})
        cores.look(10.5)
        assert os.sched_getaffinity(started[0].pid) == {first}  # too early for another look
        cores.look(20.0)
        (second,) = os.sched_getaffinity(started[0].pid)
        assert second != first
        assert os.sched_getaffinity(started[1].pid) == {second}
        assert os.sched_getaffinity(started[2].pid) == os.sched_getaffinity(0) - {second}
    finally:
        for process in started:
            process.kill()
            process.wait()


def test_a_process_that_has_ended_is_nothing_to_move():
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    assert not Path(f"/proc/{ended.pid}").exists()
    cores = SharedCores(1)
    cores.place(0, "controller_node", ended.pid)
    cores.keep_away("recorder_node", ended.pid)
    cores.look(0.0)
    cores.look(10.0)
