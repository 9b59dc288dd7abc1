# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The cores that a process runs on. No ROS import."""

import contextlib
import os
import random
import threading
import time
from collections.abc import Collection
from pathlib import Path

SAMPLE = 0.1
"""Seconds over which `least_busy_cores` measures how busy the cores are."""
SOLVER = "solver"
"""Name, for the operating system, of the threads that help a plant with its step."""


def usable_cores() -> list[int]:
    """The cores this thread may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def join_solver(cores: Collection[int]) -> None:
    """Make this thread one of the solver's: it has their name, and their cores if it may.

    If the process is pinned to one core, that one is left to the threads that share out the work.
    """
    with contextlib.suppress(OSError):  # other systems have no such file
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(SOLVER)
    if hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):
            kept_on = os.sched_getaffinity(0)
            others = set(cores) - kept_on if len(kept_on) == 1 else set()
            os.sched_setaffinity(0, others or cores)


def pin_process(core: int) -> None:
    """Keep every thread of this process on one core; threads started later also stay there. -1: on any.

    All of them, because the middleware has its own already, and it is their wake-ups that count.
    Raises ValueError when this process may not use that core.
    """
    if core < 0:
        return
    if not hasattr(os, "sched_setaffinity"):
        raise ValueError(
            "parameter 'pin': this system cannot keep a process on a core; expected -1"
        )
    allowed = sorted(os.sched_getaffinity(0))
    if core not in allowed:
        raise ValueError(f"parameter 'pin' is {core}; expected -1 or one of the cores {allowed}")
    os.sched_setaffinity(0, {core})
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has ended in the meantime
            os.sched_setaffinity(int(thread.name), {core})


def least_busy_cores(count: int) -> list[int]:
    """A core for each of `count` processes, of those this one may use: evenly, the least busy first.

    Of cores that are equally busy it takes any, so that programs that start at once spread out.
    """
    before = _busy_ticks()
    time.sleep(SAMPLE)
    after = _busy_ticks()
    busy = {core: after.get(core, 0) - before.get(core, 0) for core in usable_cores()}
    cores = sorted(busy, key=lambda core: (busy[core], random.random()))
    return [cores[i % len(cores)] for i in range(count)]


def _busy_ticks(file: Path = Path("/proc/stat")) -> dict[int, int]:
    """Ticks that each core was not idle since the machine was started (proc_stat(5)); {}: unknown."""
    ticks = {}
    with contextlib.suppress(OSError):
        for line in file.read_text().splitlines():
            name, *numbers = line.split()
            if name.startswith("cpu") and name != "cpu":
                spent = [int(number) for number in numbers[:8]]
                ticks[int(name[3:])] = sum(spent) - spent[3] - spent[4]  # idle, waiting for a disk
    return ticks


def lower_priority(niceness: int = 0) -> None:
    """Schedule this process as batch work, with `niceness` added to its own.

    A message that arrives here then does not preempt its sender.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        os.nice(niceness)
