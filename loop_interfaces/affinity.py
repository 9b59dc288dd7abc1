"""Which cores a process runs on. No ROS import."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def pin_process(core: int) -> None:
    """Keep every thread of this process on one core; threads made later stay there, too.

    All of them, because the middleware has its own already, and it is their wake-ups that count.
    Raises ValueError when this process may not use that core.
    """
    if not hasattr(os, "sched_setaffinity"):
        raise ValueError(
            "parameter 'pin': this system cannot keep a process on a core; expected -1"
        )
    allowed = sorted(os.sched_getaffinity(0))
    if core not in allowed:
        raise ValueError(f"parameter 'pin' is {core}; expected -1 or one of the cores {allowed}")
    os.sched_setaffinity(0, {core})
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread.name), {core})


def free_cores(count: int) -> list[int]:
    """A core for each of `count` processes, of those this one may use, evenly."""
    cores = (
        sorted(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else list(range(os.cpu_count() or 1))
    )
    return [cores[i % len(cores)] for i in range(count)]
