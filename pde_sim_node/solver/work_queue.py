"""The pieces of a step on a board, from which the threads take them, inside compiled functions.

Two words of memory: the ticket, turn * 2^32 + the next piece, and how many pieces are finished. Both
only change in one instruction each, and a ticket of another turn is no ticket: a thread that wakes up
late, when the next step has been put up already, takes nothing of it.
"""

from loop_interfaces.jit.atomics import compare_exchange, fetch_add, load_acquire, store_release
from loop_interfaces.jit.cache import jit

__all__ = ["BOARD", "MAX_TURN", "claim", "close", "look_up", "next_piece", "put_up", "wait"]

BOARD = 16
"""Words of a board: the two that are used, each on a cache line of its own."""
MAX_TURN = 2**31
PIECES = 32
CLOSED = 2**31
FINISHED = 64
"""Bytes from the ticket to the count."""


@jit
def put_up(board: int, turn: int) -> None:
    """All pieces of a turn, none of them finished. Only when those of the turn before are."""
    store_release(board + FINISHED, 0)
    store_release(board, turn << PIECES)


@jit
def close(board: int, turn: int) -> None:
    """No pieces until the next turn. Only when those of this one are finished."""
    store_release(board, (turn << PIECES) | CLOSED)


@jit
def look_up(board: int) -> int:
    """The turn."""
    turn: int = load_acquire(board) >> PIECES
    return turn


@jit
def claim(board: int, turn: int, pieces: int) -> int:
    """A piece of the turn that no other thread has; -1 if there is none.

    board 0: there is none, and no other thread.
    """
    if board == 0:
        return 0
    while True:
        ticket = load_acquire(board)
        piece: int = ticket - (turn << PIECES)
        if piece < 0 or piece >= pieces:
            return -1
        if compare_exchange(board, ticket, ticket + 1):
            return piece


@jit
def next_piece(board: int, turn: int, pieces: int) -> int:
    """The piece after one that is done, and what was written for which is there."""
    if board == 0:
        return -1
    fetch_add(board + FINISHED, 1)
    return claim(board, turn, pieces)


@jit
def wait(board: int, pieces: int, looks: int) -> bool:
    """Whether all pieces are done, looking so many times."""
    looked = 0
    while looked < looks and load_acquire(board + FINISHED) < pieces:
        looked += 1
    return looked < looks
