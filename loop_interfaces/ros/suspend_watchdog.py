"""A second look at a process: was it suspended (SIGSTOP, a frozen machine), is its loop stuck?"""

from __future__ import annotations

import select
import threading
import time
from collections.abc import Callable

BEAT = 0.1
"""Seconds between two beats."""
IDLE = 0.05
"""Share of a gap between two beats that a suspended process can have spent working: it worked at
most BEAT before it was stopped. One that is starved by others still gets more."""


def nap(seconds: float) -> None:
    """Sleep for so long, and not until a point of a clock: clocks jump, and tools that move them for
    tests (libfaketime) let time.sleep fail.
    """
    select.select((), (), (), seconds)


class Pulse:
    """A thread that does nothing but wake up, so that only a suspension keeps it from it.

    The loop itself is no measure: it may compute for seconds. A thread that sleeps is scheduled
    promptly even on a busy machine, and NumPy and Numba let it in between.

    each_beat: called from that thread, about every BEAT seconds.
    """

    def __init__(
        self,
        each_beat: Callable[[], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock, self._each_beat = clock, each_beat
        self._lock = threading.Lock()
        self._longest = 0.0
        self._last, self._cpu = clock(), time.process_time()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="pulse", daemon=True)

    def __enter__(self) -> Pulse:
        self._last, self._cpu = self._clock(), time.process_time()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped = True  # the thread ends with its next beat; it holds nothing

    def longest(self) -> float:
        """The longest suspension in s so far, one that has just ended included."""
        self._beat()
        return self._longest

    def _run(self) -> None:
        while not self._stopped:
            nap(BEAT)
            self._beat()
            if self._each_beat and not self._stopped:
                self._each_beat()

    def _beat(self) -> None:
        with self._lock:
            now, cpu = self._clock(), time.process_time()
            gap, worked = now - self._last, cpu - self._cpu
            self._last, self._cpu = now, cpu
            if worked < IDLE * gap:
                self._longest = max(self._longest, gap)
