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
from pde_sim_node.solver.memory import Constants, aligned
from pde_sim_node.solver.step_context import (
    SPINS,
    STEP_CONTEXT,
    step_code,
    step_environments,
    take_slices,
)
from pde_sim_node.solver.work_queue import QUEUE_WORDS, begin_turn, close, wait_until_done

POINTS_PER_SLICE = 15_000
"""Grid points, in all stages, of a slice: 30 to 40 microseconds of one thread."""
MIN_SLICES = 6
"""Below this many slices, waking another thread takes longer than it helps."""
MAX_SLICES_ALONE = 7
"""Steps of at most this many slices run on the calling thread alone, so that they are compiled code
alone: to call workers takes the interpreter."""
POLL_PERIOD = 50e-6
"""Seconds to sleep while a thread that is waited for has lost its core to another process."""


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
        self._pool = thread_pool()
        threads = 1 + self._pool.size
        self._scratch = [aligned(2 * scratch) for _ in range(threads)]
        self.plans = np.repeat(plan, threads)
        self.plans["scratch"] = [area.ctypes.data for area in self._scratch]
        self._points_per_step = points_per_step
        self._queue = aligned(QUEUE_WORDS)  # of words as long as a number
        self._contexts = np.zeros(1, STEP_CONTEXT)
        self._context = self._contexts[0]
        self._context["code"], self._context["plan"] = code, self.plans.ctypes.data
        self._context["queue"] = self._queue.ctypes.data
        if self._pool.size:  # load or compile what the first large batch would wait for
            start(self._contexts)
            done(self._contexts)
            self._help(0)

    def bind(
        self,
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
        totals: NDArray[np.float64],
        diverged_step: NDArray[np.int64],
        k: int,
    ) -> None:
        """Work on these arrays from now on, contiguous and writable; k: step of the states."""
        context, batch = self._context, len(states)
        if self._pool.size:
            shut(self._contexts)  # for a worker that wakes up late
        self._arrays = states, actions, totals, diverged_step  # kept alive
        names = "states", "actions", "totals", "diverged_step"
        for name, array in zip(names, self._arrays, strict=True):
            context[name] = array.ctypes.data
        self._slices = min(batch, batch * self._points_per_step // POINTS_PER_SLICE)
        self._shared = self._pool.size > 0 and self._slices >= MIN_SLICES
        context["batch"], context["slices"], context["step"] = batch, self._slices, k
        context["shared"] = self._shared

    def step(self) -> None:
        """Advance all environments in place."""
        if not self._shared:
            step(self._contexts)
            return
        start(self._contexts)
        self._pool.call(self._help, self._slices - 1)
        self._help(0)
        while not done(self._contexts):
            time.sleep(POLL_PERIOD)
        self._pool.dismiss()
        self._context["step"] += 1

    def _help(self, thread: int) -> None:
        plan = self.plans.ctypes.data + thread * self.plans.itemsize
        take(self._contexts, plan)

    def begin_compiled(self) -> tuple[int, int] | None:
        """Let compiled code make the steps until `end_compiled`.

        Returns
        -------
        Addresses of a C function that makes one, and of what it is called with; None where workers
        are better that have to be called from Python.
        """
        polled = self._pool.size > 0 and self._pool.polling and self._slices > 1
        if self._pool.size and not polled and self._slices > MAX_SLICES_ALONE:
            return None
        self._context["shared"] = self._context["polling"] = polled
        if polled:
            self._pool.call(self._help, self._slices - 1)
        return step_code(), self._contexts.ctypes.data

    def end_compiled(self) -> int:
        """Python makes the steps again; the step k of the states now."""
        if self._context["polling"]:
            self._context["polling"] = 0
            self._pool.dismiss()
        self._context["shared"] = self._shared
        return int(self._context["step"])


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


def compile_for_threads() -> tuple[Any, ...]:
    """What the threads call, with a STEP_CONTEXT in an array."""
    sources = fingerprint(step_context, work_queue, atomics, native)

    @cached_njit
    def step(contexts: NDArray[np.void]) -> None:
        sources  # noqa: B018  # closed over to be part of the key on disk
        step_environments(contexts[0])

    @cached_njit
    def start(contexts: NDArray[np.void]) -> None:
        sources  # noqa: B018
        begin_turn(contexts[0].queue)

    @cached_njit
    def take(contexts: NDArray[np.void], plan: int) -> None:
        sources  # noqa: B018
        take_slices(contexts[0], plan)

    @cached_njit
    def done(contexts: NDArray[np.void]) -> bool:
        sources  # noqa: B018
        return wait_until_done(contexts[0].queue, contexts[0].slices, SPINS)

    @cached_njit
    def shut(contexts: NDArray[np.void]) -> None:
        sources  # noqa: B018
        close(contexts[0].queue)

    return step, start, take, done, shut


COMPILED = step, start, take, done, shut = compile_for_threads()
