"""The compiled step of a batch of environments, shared out to the threads of a pool."""

import os
import time
from _thread import LockType
from collections.abc import Callable, Collection
from contextlib import suppress
from threading import Lock, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.affinity import join_solver, usable_cores
from loop_interfaces.jit import atomics, native
from loop_interfaces.jit.cache import cached_njit, fingerprint
from pde_sim_node.solver import step_context, work_queue
from pde_sim_node.solver.kernel_memory import Constants, aligned
from pde_sim_node.solver.step_context import (
    SPINS,
    STEP_CONTEXT,
    advance_slices,
    help_with_steps,
)
from pde_sim_node.solver.work_queue import (
    MAX_TURN,
    QUEUE_WORDS,
    begin_turn,
    close,
    wait_until_done,
)

__all__ = ["COMPILED", "ParallelStep", "use_cores"]

POINTS_PER_SLICE = 15_000
"""Grid points, in all stages, of a slice: 30 to 40 microseconds of one thread."""
MIN_SLICES = 6
"""Below this many slices, waking another thread takes longer than it helps."""
MAX_SLICES_ALONE = 7
"""Steps of at most this many slices run on the calling thread alone, so that they are compiled code
alone: to call workers takes the interpreter."""
NAP = 50e-6
"""Seconds to sleep while a thread that is waited for has lost its core to another process."""


class ParallelStep:
    """Machine code that advances environments, with its constants and a scratch for each thread.

    Parameters
    ----------
    code
        Its address, see `environments`.
    plan
        Its plan; the addresses of constants and scratch are filled in here.
    constants, scratch
        The constants, and the size of a plane of the scratch.
    points_per_step
        How much work an environment is.
    """

    def __init__(
        self, code: int, plan: Any, constants: Constants, scratch: int, *, points_per_step: int
    ) -> None:
        self._code = code
        self._constants = constants.planes()
        plan["constants"] = self._constants.ctypes.data
        plan["constants_apart"] = self._constants.size // 2
        self._pool = thread_pool()
        threads = 1 + self._pool.size
        self._scratch = [aligned(2 * scratch) for _ in range(threads)]
        self._plans = np.repeat(plan, threads)
        self._plans["scratch"] = [area.ctypes.data for area in self._scratch]
        address, size = self._plans.ctypes.data, self._plans.itemsize
        self._addresses = [address + thread * size for thread in range(threads)]
        self._points_per_step = points_per_step
        self._queue = aligned(QUEUE_WORDS)  # of words as long as a number
        self._turn = 0
        if threads > 1:  # load or compile what the first large batch would wait for
            start(self._queue.ctypes.data, 0)
            shut(self._queue.ctypes.data, 0)
            done(self._queue.ctypes.data, 0)
            help_step(np.ones(1, STEP_CONTEXT), 0)  # it is over

    def step(
        self,
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
        totals: NDArray[np.float64],
        diverged_step: NDArray[np.int64],
        k: int,
    ) -> None:
        """Advance all environments in place; arrays are contiguous and writable."""
        code, plans = self._code, self._addresses
        slices = self.slices(len(states))
        if slices < MIN_SLICES or len(plans) == 1:
            advance(code, plans[0], states, actions, totals, diverged_step, k, 0, 0, 1)
            return
        self._turn = turn = (self._turn + 1) % MAX_TURN
        address = self._queue.ctypes.data

        def take_slices(thread: int) -> None:
            advance(
                code, plans[thread], states, actions, totals, diverged_step, k,
                address, turn, slices,
            )  # fmt: skip

        start(address, turn)
        self._pool.call(take_slices, slices - 1)
        take_slices(0)
        while not done(address, slices):
            time.sleep(NAP)
        self._pool.dismiss()

    def compiled_step(self, batch: int) -> tuple[int, int, int, int] | None:
        """Code, plan, board and slices of a STEP_CONTEXT for a step of a batch; None where workers
        are better that have to be called from Python.
        """
        slices, helpers = self.slices(batch), len(self._addresses) - 1
        if helpers and self._pool.polling and slices > 1:
            return self._code, self._addresses[0], self._queue.ctypes.data, slices
        if helpers and slices > MAX_SLICES_ALONE:
            return None
        return self._code, self._addresses[0], 0, 1

    def call_workers(self, contexts: NDArray[np.void]) -> None:
        """From now on workers take slices of what `step_context.step_environments` does, until they
        are dismissed.

        contexts: one entry of STEP_CONTEXT.
        """
        record = contexts[0]
        if not record["queue"]:
            return
        record["turn"], record["over"] = self._turn, 0
        shut(self._queue.ctypes.data, self._turn)
        self._pool.call(
            lambda thread: help_step(contexts, self._addresses[thread]), record["slices"] - 1
        )

    def dismiss_workers(self, contexts: NDArray[np.void]) -> None:
        record = contexts[0]
        if record["queue"]:
            record["over"] = 1
            self._pool.dismiss()
            self._turn = int(record["turn"])

    def slices(self, batch: int) -> int:
        """How many slices a step is shared out in."""
        return min(batch, batch * self._points_per_step // POINTS_PER_SLICE)


class ThreadPool:
    """Worker threads, started on first use and never stopped.

    Nobody waits for one that has not begun, so a busy machine costs little. polling: whether they
    may poll for work while they are called.
    """

    def __init__(self, cores: Collection[int], polling: bool = False) -> None:
        self.size = len(cores) - 1
        self.polling = polling
        self._cores = cores
        self._process = 0
        self._gates: list[LockType] = []
        self._work: Callable[[int], None] | None = None

    def call(self, work: Callable[[int], None], workers: int) -> None:
        """work(thread) in at most so many threads, numbered from 1."""
        if self._process != os.getpid():  # a fork has the gates, not the threads
            self._begin()
        self._work = work
        for gate in self._gates[:workers]:
            with suppress(RuntimeError):  # it is open still: that thread has not woken up yet
                gate.release()

    def _begin(self) -> None:
        self._process = os.getpid()
        self._gates = [Lock() for _ in range(self.size)]
        for number, gate in enumerate(self._gates, 1):
            gate.acquire()
            Thread(target=self._run_worker, args=(number, gate), daemon=True).start()

    def dismiss(self) -> None:
        """The work is done."""
        self._work = None

    def _run_worker(self, number: int, gate: LockType) -> None:
        join_solver(self._cores)
        while gate.acquire():
            work = self._work
            if work is not None:
                work(number)
            del work  # it holds a plant


_POOL: list[ThreadPool] = []


def thread_pool() -> ThreadPool:
    """The one of this process; on the cores that it may use when the first plant is made."""
    if not _POOL:
        _POOL.append(ThreadPool(usable_cores()))
    return _POOL[0]


def use_cores(cores: Collection[int], *, polling: bool = False) -> None:
    """Where the threads of the plants that are made from now on may be.

    polling: they poll for work within an episode, where a step is worth it.
    """
    _POOL[:] = [ThreadPool(cores, polling)]


def compile_step() -> tuple[Any, ...]:
    """What the threads call."""
    sources = fingerprint(work_queue, step_context, atomics, native)

    @cached_njit
    def advance(
        code: int,
        plan: int,
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
        totals: NDArray[np.float64],
        diverged_step: NDArray[np.int64],
        k: int,
        queue: int,
        turn: int,
        slices: int,
    ) -> None:
        """Advance the environments of those slices of the turn that no other thread has; of
        the only one without a queue.
        """
        sources  # noqa: B018  # closed over to be part of the key on disk
        batch = len(totals)
        z, a = states.ctypes.data, actions.ctypes.data
        c, ended = totals.ctypes.data, diverged_step.ctypes.data
        advance_slices(code, plan, z, a, c, ended, k, batch, queue, turn, slices)

    @cached_njit
    def help_step(contexts: NDArray[np.void], plan: int) -> None:
        sources  # noqa: B018
        help_with_steps(contexts[0], plan)

    @cached_njit
    def start(address: int, turn: int) -> None:
        sources  # noqa: B018
        begin_turn(address, turn)

    @cached_njit
    def shut(address: int, turn: int) -> None:
        sources  # noqa: B018
        close(address, turn)

    @cached_njit
    def done(address: int, slices: int) -> bool:
        sources  # noqa: B018
        return wait_until_done(address, slices, SPINS)

    return advance, help_step, start, shut, done


COMPILED = advance, help_step, start, shut, done = compile_step()
