# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The compiled step of a batch of environments, shared out to the threads of a pool."""

import ctypes
import os
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.process.affinity import join_solver, usable_cores
from pdeloop.solver.memory import Constants, aligned

SHARED_POINTS = 90_000
"""Grid points, in all stages, from which on a step is shared: some 190 microseconds of one thread. A
smaller one is done before another thread has woken up."""
COMPILED_POINTS = 120_000
"""Below this a step is compiled code alone where that saves the way through the interpreter."""


ENVIRONMENTS = ctypes.CFUNCTYPE(None, *[ctypes.c_ssize_t] * 8)
"""The type of the compiled step; a call leaves the interpreter's lock to others."""


class ParallelStep:
    """Machine code that advances environments, with its constants and a scratch for each thread.

    code: gives its address, see `batch_step.environments_of`; plan: its plan, where the addresses
    of constants and scratch are filled in; scratch: size of a plane of it; points_per_step: how much
    work an environment is; called: gives the addresses of what `code` calls, by their entry in the
    plan. The memory of `constants` is what `plans`, one for each thread, have the address of.

    Nothing is compiled before `load`, or the first step.
    """

    def __init__(
        self,
        code: Callable[[], int],
        plan: Any,
        constants: Constants,
        scratch: int,
        *,
        points_per_step: int,
        called: Mapping[str, Callable[[], int]] = MappingProxyType({}),
    ) -> None:
        self.constants = constants.planes()
        plan["constants"] = self.constants.ctypes.data
        plan["constants_apart"] = self.constants.size // 2
        threads = len(solver_threads.cores)
        self._scratch = [aligned(2 * scratch) for _ in range(threads)]
        self.plans = np.repeat(plan, threads)
        self.plans["scratch"] = [area.ctypes.data for area in self._scratch]
        self._points_per_step = points_per_step
        self._address_of, self._called = code, called
        self._code = 0
        self._environments = ENVIRONMENTS(self._code)

    @property
    def code(self) -> int:
        """Address of the machine code."""
        self.load()
        return self._code

    def load(self) -> None:
        """Load the machine code from disk, or compile it."""
        if self._code:
            return
        for name, address in self._called.items():
            self.plans[name] = address()
        self._code = self._address_of()
        self._environments = ENVIRONMENTS(self._code)

    def bind(
        self,
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
        totals: NDArray[np.float64],
        diverged_step: NDArray[np.int64],
    ) -> None:
        """Work on these arrays from now on, contiguous and writable."""
        self._arrays = states, actions, totals, diverged_step  # kept alive
        batch, places = len(states), [array.ctypes.data for array in self._arrays]
        self._points = batch * self._points_per_step
        parts = min(len(self.plans), batch) if self._points >= SHARED_POINTS else 1
        edges = [batch * part // parts for part in range(parts + 1)]
        self._parts = [
            (self.plans[part : part + 1].ctypes.data, *places, first, last)
            for part, (first, last) in enumerate(pairwise(edges))
        ]

    @property
    def shared(self) -> bool:
        """True where the threads of the pool are better than compiled code that one thread calls."""
        return len(self._parts) > 1 and self._points >= COMPILED_POINTS

    def step(self, k: int) -> None:
        """Advance all environments in place; k: step of the states."""
        if not self._code:
            self.load()
        own, *others = self._parts
        begun = [solver_threads.pool().submit(self._environments, *it, k) for it in others]
        self._environments(*own, k)
        for part, it in zip(begun, others, strict=True):
            if part.cancel():  # its thread has not woken up: its core is busy
                self._environments(*it, k)
            else:
                part.result()


class SolverThreads:
    """The threads that share the steps of this process's plants, started on first use.

    cores: where they may be, those that the process was started on, as this is read at import,
    before a node is pinned. There are as many threads, with the one that asks for a step.
    """

    def __init__(self) -> None:
        self.cores: Collection[int] = usable_cores()
        self._pool: ThreadPoolExecutor | None = None
        os.register_at_fork(after_in_child=self.forget)

    def pool(self) -> ThreadPoolExecutor:
        """The worker threads, apart from the one that asks for a step."""
        if self._pool is None:
            helpers = len(self.cores) - 1
            self._pool = ThreadPoolExecutor(helpers, "solver", join_solver, (self.cores,))
        return self._pool

    def forget(self) -> None:
        """Start others with the next step: a fork has none of them."""
        self._pool = None


solver_threads = SolverThreads()


def use_cores(cores: Collection[int]) -> None:
    """Set the cores for the threads of plants that are made from now on."""
    solver_threads.cores = cores
    solver_threads.forget()
