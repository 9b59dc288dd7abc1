# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Clocks of machines that jump by days, each differently, change nothing: waits use monotonic ones."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.loop_harness import Processes, until
from tests.support.operator_harness import SLOW, full_speed, operator
from tests.support.small_loop import (
    LIMIT,
    PARAMETERS,
    adapted,
    assert_same_training,
    in_process,
    start_tuner,
)

pytestmark = pytest.mark.topics


STUCK = """
import rclpy
from pdeloop.ros import node_loop
from pdeloop.messages.topics import ACTION, STATE
from tests.support.fast_path_pair import Controller
node_loop.HOUSEKEEPING = node_loop.WAIT = 600.0  # as long as a wait until a moment that was set back
rclpy.init()
loop = node_loop.NodeLoop(rclpy.create_node("stuck"))

def turn():
    turns.append(None)
    if len(turns) == 6:
        loop.stop("enough")

turns = []  # an event or two of the graph may be among them
loop.run(tick=print, deadline=turn, housekeeping=lambda now: None)
print(len(turns), "turns")

# With a fast path that is armed all the time.
controller = Controller(2)
controller.begin(4)
controller.ordinary(controller.state(4, 0))
loop.answer_fast(loop.receive(STATE, lambda frame: None), loop.sender(ACTION), controller.path)
turns.clear()
loop.resume()
loop.run(tick=print, deadline=turn, housekeeping=lambda now: None)
print(len(turns), "turns")
"""


def test_a_wait_that_would_last_until_the_clock_is_there_again_is_ended(loop: Processes):
    lines = loop.wait(loop.start("-c", STUCK, name="stuck"), LIMIT).splitlines()
    assert lines == 2 * ["6 turns"]


def newest_time(out: Path) -> float:
    """What the tuner's clock said last."""
    *_, last = re.findall(r'"time": ([0-9.]+)', (out / "progress.jsonl").read_text())
    return float(last)


@pytest.fixture
def faketime() -> Iterator[Path]:
    """The library of faketime. Its files in shared memory outlive a process that is killed."""
    found = list(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"))
    if not found:
        pytest.skip("needs Debian's faketime (make packages)")
    before = shared_memory()
    yield found[0]
    for name in shared_memory() - before:
        _, _, owner = name.rpartition("_")
        if not Path("/proc", owner).exists():
            Path("/dev/shm", name).unlink(missing_ok=True)


def shared_memory() -> set[str]:
    """The names of faketime's files in shared memory, each with the id of its process."""
    return {path.name for path in Path("/dev/shm").glob("*faketime_*")}


DAYS = {"plant": (-3, 0, 2), "controller": (0, 2, -3), "tuner": (2, -3, 0)}
"""How far the clock of each node's machine is off, one after the other."""


def test_clocks_that_jump_forth_and_back_and_differ_change_nothing(
    faketime: Path, loop: Processes, tmp_path: Path
):
    def set_clocks(turn: int) -> None:
        for name, days in DAYS.items():
            (tmp_path / name).write_text(f"{days[turn]:+d}d\n")

    def use_clock(name: str) -> None:
        loop.environment["FAKETIME_TIMESTAMP_FILE"] = str(tmp_path / name)

    set_clocks(2)
    out = tmp_path / "run"
    with operator(loop) as desk:
        loop.forks = False  # the library must be there when a program starts
        loop.environment |= {
            "LD_PRELOAD": str(faketime),
            "FAKETIME_CACHE_DURATION": "1",  # a jump is seen within so many seconds
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            "FAKETIME_DONT_RESET": "1",
        }
        use_clock("plant")
        # Slow until all jumps were seen.
        loop.node("pde_sim_node", *PARAMETERS, "-p", f"real_time_factor:={SLOW}")
        use_clock("controller")
        loop.node("controller_node", *PARAMETERS)
        use_clock("tuner")
        tuner = start_tuner(loop, out, iterations=40)
        until(lambda: adapted(out) >= 1, LIMIT, "iteration 1")
        for turn, days in enumerate(DAYS["tuner"]):
            set_clocks(turn)
            wanted = 86400 * days
            until(lambda d=wanted: abs(newest_time(out) - time.time() - d) < 3600, LIMIT, "jump")
        full_speed(desk)
        loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=40))
