# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Watchdog that detects a suspended process (SIGSTOP, a frozen machine) and a stuck event loop."""

from __future__ import annotations

import select
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PERIOD = 0.1
"""Seconds between two ticks."""
IDLE = 0.05
"""Share of a gap between two ticks that a suspended process can have spent working: it worked at
most PERIOD before it was stopped. One that is starved by others still gets more."""


def sleep_for(seconds: float) -> None:
    """Sleep for a time, not until a point of a clock.

    Clocks jump, and tools that move them for tests (libfaketime) let time.sleep fail.
    """
    select.select((), (), (), seconds)


class SuspendWatchdog:
    """A thread that does nothing but wake up, so that only a suspension keeps it from it.

    The loop itself cannot tell: it may compute for seconds. A thread that sleeps is scheduled
    promptly even on a busy machine, and NumPy and Numba let it in between.

    on_tick: called from that thread, about every PERIOD seconds.
    """

    def __init__(
        self, on_tick: Callable[[], None] | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock, self._on_tick = clock, on_tick
        self._lock = threading.Lock()
        self._longest = 0.0
        self._last, self._cpu = clock(), time.process_time()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> SuspendWatchdog:
        self._last, self._cpu = self._clock(), time.process_time()
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._thread = None  # it ends with its next beat; it holds nothing

    @property
    def running(self) -> bool:
        """True within its block."""
        return self._thread is not None

    def longest(self) -> float:
        """The longest suspension in s so far, one that has just ended included."""
        self._tick()
        return self._longest

    @contextmanager
    def calling(self, on_tick: Callable[[], None]) -> Iterator[None]:
        """Call another function on ticks in the block."""
        former, self._on_tick = self._on_tick, on_tick
        try:
            yield
        finally:
            self._on_tick = former

    def _run(self) -> None:
        me = threading.current_thread()
        while self._thread is me:
            sleep_for(PERIOD)
            self._tick()
            on_tick = self._on_tick
            if on_tick and self._thread is me:
                on_tick()

    def _tick(self) -> None:
        with self._lock:
            now, cpu = self._clock(), time.process_time()
            gap, worked = now - self._last, cpu - self._cpu
            self._last, self._cpu = now, cpu
            if worked < IDLE * gap:
                self._longest = max(self._longest, gap)
