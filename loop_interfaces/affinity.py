"""Which cores a process runs on. No ROS import."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Collection
from pathlib import Path

SOLVER = "solver"
"""Name, for the operating system, of the threads that help a plant with its step."""


def usable_cores() -> list[int]:
    """The cores this thread may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def core_list(text: str) -> list[int]:
    """Cores as `taskset -c` takes them, like 0-3,6. ValueError, one sentence, for anything else."""
    present, cores = os.cpu_count() or 1, set()
    try:
        for part in text.split(","):
            first, _, last = part.partition("-")
            span = range(int(first), int(last or first) + 1)
            if not span or span[-1] >= present:
                raise ValueError
            cores |= set(span)
    except ValueError:
        raise ValueError(
            f"cores are {text!r}; expected some of 0-{present - 1}, in a list like 0-3,6"
        ) from None
    return sorted(cores)


def core_text(cores: Collection[int]) -> str:
    """The list that `core_list` takes."""
    return ",".join(map(str, sorted(cores)))


def join_solver(cores: Collection[int]) -> None:
    """Make this thread one of the solver's: it has their name, and their cores if it may.

    The core that the process is kept on, if it is, it leaves to those who call for help.
    """
    with contextlib.suppress(OSError):  # other systems have no such file
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(SOLVER)
    if hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):
            kept_on = os.sched_getaffinity(0)
            others = set(cores) - kept_on if len(kept_on) == 1 else set()
            os.sched_setaffinity(0, others or cores)


def helps_solver(process: int, thread: int) -> bool:
    """Whether a thread is one of those."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/task/{thread}/comm").read_text().strip() == SOLVER
    return False


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
    cores = usable_cores()
    return [cores[i % len(cores)] for i in range(count)]
