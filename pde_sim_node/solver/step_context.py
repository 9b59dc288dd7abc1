"""A step as machine code alone, inside compiled functions: by one thread, or shared with helpers that
look for work all the time.
"""

from typing import Any, NamedTuple

import numpy as np

from loop_interfaces.jit.cache import jit
from loop_interfaces.jit.native import call_c
from pde_sim_node.solver.work_queue import MAX_TURN, claim, look_up, next_piece, put_up, wait

__all__ = ["MACHINE", "Machine", "help_out", "step_together", "work"]

LOOKS = 1_000_000


class Machine(NamedTuple):
    """What it takes. Addresses, but for the numbers of environments and of pieces of work.

    code: see `environments` for what it is called with; board: 0 where nobody helps.
    """

    code: int
    plan: int
    board: int
    pieces: int
    states: int
    actions: int
    totals: int
    diverged_step: int
    batch: int


MACHINE = np.dtype(
    [
        *((name, np.int64) for name in Machine._fields),
        ("step", np.int64),
        ("turn", np.int64),  # of the board
        ("over", np.int64),  # whether the helpers may go
    ]
)


@jit
def work(
    code: int,
    plan: int,
    states: int,
    actions: int,
    totals: int,
    diverged_step: int,
    k: int,
    batch: int,
    board: int,
    turn: int,
    pieces: int,
) -> None:
    """Advance the environments of those pieces of the turn on the board that no other thread has; of
    the one there is without a board.
    """
    piece = claim(board, turn, pieces)
    while piece >= 0:
        first, last = batch * piece // pieces, batch * (piece + 1) // pieces
        call_c(code, (plan, states, actions, totals, diverged_step, first, last, k))
        piece = next_piece(board, turn, pieces)


@jit
def work_on(machine: Any, plan: int, turn: int) -> None:
    work(
        machine.code,
        plan,
        machine.states,
        machine.actions,
        machine.totals,
        machine.diverged_step,
        machine.step,
        machine.batch,
        machine.board,
        turn,
        machine.pieces,
    )


@jit
def step_together(machine: Any) -> None:
    """Advance all environments from `machine.step` to the next."""
    board = machine.board
    if board != 0:
        machine.turn = (machine.turn + 1) & (MAX_TURN - 1)
        put_up(board, machine.turn)
    work_on(machine, machine.plan, machine.turn)
    while board != 0 and not wait(board, machine.pieces, LOOKS):
        pass
    machine.step += 1


@jit
def help_out(machine: Any, plan: int) -> None:
    """Take pieces of every step until it is over, with a plan of one's own."""
    while machine.over == 0:
        work_on(machine, plan, look_up(machine.board))
