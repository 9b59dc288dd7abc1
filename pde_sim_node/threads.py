"""Environments side by side in threads: a compiled step shared out to the cores."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .layout import Constants, aligned

__all__ = ["PlanTeam", "ThreadTeam", "available_cores"]

POINTS_PER_PIECE = 30_000
"""Grid points, in all stages, of a piece of work for a thread: about 50 microseconds."""
WORTHWHILE_PIECES = 3
"""Below this many pieces, waking another thread takes longer than it helps."""


class PlanTeam:
    """A compiled step with its constants, and with a scratch for each thread.

    Parameters
    ----------
    step
        The compiled step: (states, actions, totals, diverged_step, k, plans, which, begin, end).
    plan
        Its plan; the addresses of constants and scratch are filled in here.
    constants, scratch
        The constants, and the size of a plane of the scratch.
    points_per_step
        How much work an environment is.
    """

    def __init__(
        self, step: Any, plan: Any, constants: Constants, scratch: int, *, points_per_step: int
    ) -> None:
        self._step = step
        self._constants = constants.planes()
        plan["constants"] = self._constants.ctypes.data
        plan["constants_apart"] = self._constants.size // 2
        self._threads = ThreadTeam(available_cores())
        self._scratch = [aligned(2 * scratch) for _ in range(self._threads.size)]
        self._plans = np.repeat(plan, self._threads.size)
        self._plans["scratch"] = [area.ctypes.data for area in self._scratch]
        self._points_per_step = points_per_step

    def step(
        self,
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
        totals: NDArray[np.float64],
        diverged_step: NDArray[np.int64],
        k: int,
    ) -> None:
        """Advance all environments in place; arrays are contiguous and writable."""
        batch = len(states)
        pieces = min(batch, batch * self._points_per_step // POINTS_PER_PIECE)
        if pieces < WORTHWHILE_PIECES or self._threads.size == 1:
            self._step(states, actions, totals, diverged_step, k, self._plans, 0, 0, batch)
            return

        def advance(thread: int, piece: int) -> None:
            begin, end = batch * piece // pieces, batch * (piece + 1) // pieces
            self._step(states, actions, totals, diverged_step, k, self._plans, thread, begin, end)

        self._threads.run(advance, pieces)


class ThreadTeam:
    """The calling thread and others beside it, which exist from their first use on."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._process = 0
        self._pool: ThreadPoolExecutor | None = None

    def run(self, work: Callable[[int, int], None], pieces: int) -> None:
        """work(thread, piece) for every piece, each by whichever thread is free.

        The caller waits for no thread that has not begun, so a busy machine costs little.
        """
        if (
            self._pool is None or self._process != os.getpid()
        ):  # a fork has the pool, not its threads
            self._pool = ThreadPoolExecutor(self.size - 1, thread_name_prefix="plant")
            self._process = os.getpid()
        remaining = iter(range(pieces))

        def take(thread: int) -> None:
            for piece in remaining:
                work(thread, piece)

        others = [self._pool.submit(take, thread) for thread in range(1, min(self.size, pieces))]
        take(0)
        for other in others:
            if not other.cancel():
                other.result()


def available_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
