"""Environments side by side in threads: a compiled step shared out to the cores."""

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
from pde_sim_node.solver.step_context import LOOKS, MACHINE, help_out, work
from pde_sim_node.solver.work_queue import BOARD, MAX_TURN, close, put_up, wait

__all__ = ["TEAMWORK", "PlanTeam", "use_cores"]

POINTS_PER_PIECE = 15_000
"""Grid points, in all stages, of a piece of work for a thread: 30 to 40 microseconds."""
WORTHWHILE_PIECES = 6
"""Below this many pieces, waking another thread takes longer than it helps."""
LONE_PIECES = 7
"""Up to this many pieces of a step a thread does best that has everything else to do, too: with
helpers the interpreter is between two steps."""
NAP = 50e-6
"""Seconds that it sleeps then: the thread it waits for has lost its core to somebody else."""


class PlanTeam:
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
        self._crew = crew()
        threads = 1 + self._crew.size
        self._scratch = [aligned(2 * scratch) for _ in range(threads)]
        self._plans = np.repeat(plan, threads)
        self._plans["scratch"] = [area.ctypes.data for area in self._scratch]
        address, size = self._plans.ctypes.data, self._plans.itemsize
        self._addresses = [address + thread * size for thread in range(threads)]
        self._points_per_step = points_per_step
        self._board = aligned(BOARD)  # of words as long as a number
        self._turn = 0
        if threads > 1:  # load or compile what the first large batch would wait for
            start(self._board.ctypes.data, 0)
            shut(self._board.ctypes.data, 0)
            done(self._board.ctypes.data, 0)
            stand_by(np.ones(1, MACHINE), 0)  # it is over

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
        pieces = self.pieces(len(states))
        if pieces < WORTHWHILE_PIECES or len(plans) == 1:
            work_off(code, plans[0], states, actions, totals, diverged_step, k, 0, 0, 1)
            return
        self._turn = turn = (self._turn + 1) % MAX_TURN
        address = self._board.ctypes.data

        def take_pieces(thread: int) -> None:
            work_off(
                code, plans[thread], states, actions, totals, diverged_step, k,
                address, turn, pieces,
            )  # fmt: skip

        start(address, turn)
        self._crew.call(take_pieces, pieces - 1)
        take_pieces(0)
        while not done(address, pieces):
            time.sleep(NAP)
        self._crew.dismiss()

    def in_machine_code(self, batch: int) -> tuple[int, int, int, int] | None:
        """Code, plan, board and pieces of a `Machine` that does a step of a batch; None where helpers
        are better, who are called from Python.
        """
        pieces, helpers = self.pieces(batch), len(self._addresses) - 1
        if helpers and self._crew.attentive and pieces > 1:
            return self._code, self._addresses[0], self._board.ctypes.data, pieces
        if helpers and pieces > LONE_PIECES:
            return None
        return self._code, self._addresses[0], 0, 1

    def call_helpers(self, machines: NDArray[np.void]) -> None:
        """From now on helpers take pieces of what `step_context.step_together` does, until they are
        dismissed.

        machines: one entry of MACHINE.
        """
        record = machines[0]
        if not record["board"]:
            return
        record["turn"], record["over"] = self._turn, 0
        shut(self._board.ctypes.data, self._turn)
        self._crew.call(
            lambda thread: stand_by(machines, self._addresses[thread]), record["pieces"] - 1
        )

    def dismiss_helpers(self, machines: NDArray[np.void]) -> None:
        record = machines[0]
        if record["board"]:
            record["over"] = 1
            self._crew.dismiss()
            self._turn = int(record["turn"])

    def pieces(self, batch: int) -> int:
        """How many pieces of work for a thread a step is."""
        return min(batch, batch * self._points_per_step // POINTS_PER_PIECE)


class Crew:
    """Threads that lend a hand to whoever calls. They exist from the first call on, for ever.

    Nobody waits for one that has not begun, so a busy machine costs little. attentive: whether they
    may look for work all the time while they are called.
    """

    def __init__(self, cores: Collection[int], attentive: bool = False) -> None:
        self.size = len(cores) - 1
        self.attentive = attentive
        self._cores = cores
        self._process = 0
        self._gates: list[LockType] = []
        self._work: Callable[[int], None] | None = None

    def call(self, work: Callable[[int], None], hands: int) -> None:
        """work(thread) in at most so many threads, numbered from 1."""
        if self._process != os.getpid():  # a fork has the gates, not the threads
            self._begin()
        self._work = work
        for gate in self._gates[:hands]:
            with suppress(RuntimeError):  # it is open still: that thread has not woken up yet
                gate.release()

    def _begin(self) -> None:
        self._process = os.getpid()
        self._gates = [Lock() for _ in range(self.size)]
        for number, gate in enumerate(self._gates, 1):
            gate.acquire()
            Thread(target=self._stand_by, args=(number, gate), daemon=True).start()

    def dismiss(self) -> None:
        """The work is done: there is nothing left to lend a hand with."""
        self._work = None

    def _stand_by(self, number: int, gate: LockType) -> None:
        join_solver(self._cores)
        while gate.acquire():
            work = self._work
            if work is not None:
                work(number)
            del work  # it holds a plant


_CREW: list[Crew] = []


def crew() -> Crew:
    """The one of this process; on the cores that it may use when the first plant is made."""
    if not _CREW:
        _CREW.append(Crew(usable_cores()))
    return _CREW[0]


def use_cores(cores: Collection[int], *, attentive: bool = False) -> None:
    """Where the threads of the plants that are made from now on may be.

    attentive: they look for work all the time within an episode, where a step is worth it.
    """
    _CREW[:] = [Crew(cores, attentive)]


def compile_board() -> tuple[Any, ...]:
    """What the threads call."""
    sources = fingerprint(work_queue, step_context, atomics, native)

    @cached_njit
    def work_off(
        code: int,
        plan: int,
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
        totals: NDArray[np.float64],
        diverged_step: NDArray[np.int64],
        k: int,
        at: int,
        turn: int,
        pieces: int,
    ) -> None:
        """Advance the environments of those pieces of the turn on the board that no other thread has;
        of the one there is without a board.
        """
        sources  # noqa: B018  # closed over to be part of the key on disk
        batch = len(totals)
        z, a = states.ctypes.data, actions.ctypes.data
        c, ended = totals.ctypes.data, diverged_step.ctypes.data
        work(code, plan, z, a, c, ended, k, batch, at, turn, pieces)

    @cached_njit
    def stand_by(machines: NDArray[np.void], plan: int) -> None:
        sources  # noqa: B018
        help_out(machines[0], plan)

    @cached_njit
    def start(address: int, turn: int) -> None:
        sources  # noqa: B018
        put_up(address, turn)

    @cached_njit
    def shut(address: int, turn: int) -> None:
        sources  # noqa: B018
        close(address, turn)

    @cached_njit
    def done(address: int, pieces: int) -> bool:
        sources  # noqa: B018
        return wait(address, pieces, LOOKS)

    return work_off, stand_by, start, shut, done


TEAMWORK = work_off, stand_by, start, shut, done = compile_board()
