# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The compiled step of a batch of environments, shared out to the threads of a pool."""

import os
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.affinity import join_solver, usable_cores
from loop_interfaces.jit import native
from loop_interfaces.jit.cache import cached_njit
from pde_sim_node.solver import step_context
from pde_sim_node.solver.memory import Constants, aligned
from pde_sim_node.solver.step_context import STEP_CONTEXT, advance, step_code

SHARED_POINTS = 90_000
"""Grid points, in all stages, from which on a step is shared: some 190 microseconds of one thread. A
smaller one is done before another thread has woken up."""
COMPILED_POINTS = 120_000
"""Below this a step is compiled code alone where that saves the way through the interpreter."""


@cached_njit(step_context, native)
def advance_part(contexts: NDArray[np.void], plan: int, first: int, last: int) -> None:
    """Advance the environments first, ..., last - 1 of the STEP_CONTEXT in an array."""
    advance(contexts[0], plan, first, last)


class ParallelStep:
    """Machine code that advances environments, with its constants and a scratch for each thread.

    Parameters
    ----------
    code
        Its address, see `batch_step.environments_of`.
    plan
        Its plan; the addresses of constants and scratch are filled in here.
    constants, scratch
        The constants, and the size of a plane of the scratch.
    points_per_step
        How much work an environment is.

    Attributes
    ----------
    constants : array
        The memory that the plans have the address of.
    plans : structured array
        The plan of each thread.
    """

    def __init__(
        self, code: int, plan: Any, constants: Constants, scratch: int, *, points_per_step: int
    ) -> None:
        self.constants = constants.planes()
        plan["constants"] = self.constants.ctypes.data
        plan["constants_apart"] = self.constants.size // 2
        threads = len(solver_threads.cores)
        self._scratch = [aligned(2 * scratch) for _ in range(threads)]
        self.plans = np.repeat(plan, threads)
        self.plans["scratch"] = [area.ctypes.data for area in self._scratch]
        self._points_per_step = points_per_step
        self._contexts = np.zeros(1, STEP_CONTEXT)
        self._context = self._contexts[0]
        self._context["code"], self._context["plan"] = code, self.plans.ctypes.data
        advance_part(self._contexts, self.plans.ctypes.data, 0, 0)  # load or compile it

    def bind(
        self,
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
        totals: NDArray[np.float64],
        diverged_step: NDArray[np.int64],
        k: int,
    ) -> None:
        """Work on these arrays from now on, contiguous and writable; k: step of the states."""
        self._arrays = states, actions, totals, diverged_step  # kept alive
        context, batch = self._context, len(states)
        names = "states", "actions", "totals", "diverged_step"
        for name, array in zip(names, self._arrays, strict=True):
            context[name] = array.ctypes.data
        context["batch"], context["step"] = batch, k
        self._points = batch * self._points_per_step
        parts = min(len(self.plans), batch) if self._points >= SHARED_POINTS else 1
        edges = [batch * part // parts for part in range(parts + 1)]
        addresses = (self.plans[part : part + 1].ctypes.data for part in range(parts))
        self._parts = list(zip(addresses, edges[:-1], edges[1:], strict=True))

    def step(self) -> None:
        """Advance all environments in place."""
        own, *others = self._parts
        begun = [solver_threads.pool().submit(advance_part, self._contexts, *it) for it in others]
        advance_part(self._contexts, *own)
        for part, it in zip(begun, others, strict=True):
            if part.cancel():  # its thread has not woken up: its core is busy
                advance_part(self._contexts, *it)
            else:
                part.result()
        self._context["step"] += 1

    def begin_compiled(self) -> tuple[int, int] | None:
        """Let compiled code make the steps until `end_compiled`.

        Returns
        -------
        Addresses of a C function that makes one, and of what it is called with; None where several
        threads are better, which have to be called from Python.
        """
        if len(self._parts) > 1 and self._points >= COMPILED_POINTS:
            return None
        return step_code(), self._contexts.ctypes.data

    def end_compiled(self) -> int:
        """Python makes the steps again; the step k of the states now."""
        return int(self._context["step"])


class SolverThreads:
    """The threads that share the steps of this process's plants, started on first use.

    Attributes
    ----------
    cores : collection of int
        Where they may be: those that the process was started on, as this is read at import, before a
        node is pinned. There are as many threads, with the one that asks for a step.
    """

    def __init__(self) -> None:
        self.cores: Collection[int] = usable_cores()
        self._pool: ThreadPoolExecutor | None = None
        os.register_at_fork(after_in_child=self.forget)

    def pool(self) -> ThreadPoolExecutor:
        """Those beside the thread that asks for a step."""
        if self._pool is None:
            helpers = len(self.cores) - 1
            self._pool = ThreadPoolExecutor(helpers, "solver", join_solver, (self.cores,))
        return self._pool

    def forget(self) -> None:
        """Start others with the next step: a fork has none of them."""
        self._pool = None


solver_threads = SolverThreads()


def use_cores(cores: Collection[int]) -> None:
    """Where the threads of the plants that are made from now on may be."""
    solver_threads.cores = cores
    solver_threads.forget()
