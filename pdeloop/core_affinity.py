"""Plant and controller of a pair on one core: they take turns, so one is enough.

A message to a process on another core has to wake that core if it is idle, which takes longer than
the rest of a round where idle cores sleep deeply (in virtual machines above all). On one core the
receiver goes on where the sender waits. It also leaves the other cores to the tuner, to those who
record or watch, and to the threads that help the plant with the step of a large batch.
"""

from __future__ import annotations

import contextlib
import os
import random
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from loop_interfaces.affinity import free_cores, helps_solver, usable_cores

PERIOD = 2.0
"""Seconds between two looks at how busy the cores are, on average."""
START_UP = 1.2
"""Seconds after its start in which a process is on all cores: the two of a pair start side by side."""
CROWDED = 0.3
"""Share of a core taken by others, beyond that on the freest one, from which a pair moves there."""

_STAT = Path("/proc/stat")


def possible() -> bool:
    """Whether pairs can share a core on this system, and have more than one to choose from."""
    return hasattr(os, "sched_setaffinity") and len(usable_cores()) > 1 and _STAT.exists()


def freest(taken: Mapping[int, float], present: int) -> int:
    """The core to be on.

    taken: share of each core that others take; present: the core now, left only for one that is
    clearly freer.
    """
    best = min(taken, key=lambda core: (taken[core], core))
    return best if taken.get(present, 1.0) > taken[best] + CROWDED else present


@dataclass
class _Pair:
    core: int
    processes: dict[str, int] = field(default_factory=dict)
    ticks: int = 0


class SharedCores:
    """Keeps the processes of each pair on one core, and moves a pair whose core others need."""

    def __init__(self, pairs: int) -> None:
        self._pairs = [_Pair(core) for core in free_cores(pairs)]
        self._cores = usable_cores()
        self._busy = self._total = dict.fromkeys(self._cores, 0)
        self._next = float("-inf")
        self._starting: deque[tuple[float, int, _Pair]] = deque()
        self._away: dict[str, int] = {}

    def place(self, pair: int, name: str, process: int, started: float | None = None) -> None:
        """A process of a pair is there, perhaps in place of one of the same name.

        started: when (monotonic s), if just now: it joins the other one START_UP later.
        """
        place = self._pairs[pair]
        place.processes[name] = process
        if started is None:
            _move(process, place.core, self._cores)
        else:
            self._starting.append((started + START_UP, process, place))

    def keep_away(self, name: str, process: int) -> None:
        """Keep a process, perhaps in place of one of the same name, off the cores of the pairs, if
        there are others: the scheduler would have it wait for its turn on any of them.
        """
        self._away[name] = process
        self._move_away(process)

    def _move_away(self, process: int) -> None:
        others = set(self._cores) - {pair.core for pair in self._pairs} or set(self._cores)
        for thread in _threads(process):
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(thread, others)

    def look(self, now: float) -> None:
        """Call it often; now: monotonic s."""
        while self._starting and self._starting[0][0] <= now:
            _, process, place = self._starting.popleft()
            if process in place.processes.values():
                _move(process, place.core, self._cores)
        if now < self._next:
            return
        # At no regular times: two runs that look together would leave for the same core together.
        first, self._next = self._next < 0.0, now + PERIOD * random.uniform(0.5, 1.5)
        busy, total = _ticks(self._cores)
        for pair in self._pairs:
            before, pair.ticks = pair.ticks, sum(map(_used, pair.processes.values()))
            if first:
                continue
            taken = {
                core: (busy[core] - self._busy[core]) / max(total[core] - self._total[core], 1)
                for core in self._cores
            }
            own = max(0, pair.ticks - before)
            taken[pair.core] -= own / max(total[pair.core] - self._total[pair.core], 1)
            core = freest(taken, pair.core)
            if core != pair.core:
                pair.core = core
                for process in pair.processes.values():
                    _move(process, core, self._cores)
                for process in self._away.values():
                    self._move_away(process)
        self._busy, self._total = busy, total


def _move(process: int, core: int, cores: Collection[int]) -> None:
    """Every thread but those that help the solver, which go to the others of `cores`."""
    others = set(cores) - {core} or {core}
    for thread in _threads(process):
        with contextlib.suppress(ProcessLookupError):
            os.sched_setaffinity(thread, others if helps_solver(process, thread) else {core})


def _threads(process: int) -> list[int]:
    """Of a process; none of one that has ended."""
    try:
        return [int(thread.name) for thread in Path(f"/proc/{process}/task").iterdir()]
    except OSError:
        return []


def _ticks(cores: list[int]) -> tuple[dict[int, int], dict[int, int]]:
    """Ticks that each core was busy, and all of them, since the machine was started."""
    busy, total = dict.fromkeys(cores, 0), dict.fromkeys(cores, 0)
    for line in _STAT.read_text().splitlines():
        name, *numbers = line.split()
        if name.startswith("cpu") and name[3:].isdigit() and int(name[3:]) in busy:
            spent = [int(number) for number in numbers[:8]]
            total[int(name[3:])] = sum(spent)
            busy[int(name[3:])] = sum(spent) - spent[3] - spent[4]  # idle, waiting for a disk
    return busy, total


def _used(process: int) -> int:
    """Ticks that a process has used; 0 of one that has ended."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0
    return int(fields[11]) + int(fields[12])
