"""The pieces of a step on a board, from which the threads take them, inside compiled functions.

Two words of memory: the ticket, turn * 2^32 + the next piece, and how many pieces are finished. Both
only change in one instruction each, and a ticket of another turn is no ticket: a thread that wakes up
late, when the next step has been put up already, takes nothing of it.
"""

from typing import Any

from llvmlite import ir
from numba import types

from loop_interfaces.compiled import jit
from loop_interfaces.simd import intrinsic

__all__ = ["BOARD", "MAX_TURN", "claim", "next_piece", "put_up", "wait"]

BOARD = 16
"""Words of a board: the two that are used, each on a cache line of its own."""
MAX_TURN = 2**31
PIECES = 32
FINISHED = 64
"""Bytes from the ticket to the count."""
WORD = ir.IntType(64)


def place(builder: Any, address: Any) -> Any:
    return builder.inttoptr(address, WORD.as_pointer())


@intrinsic
def look(typing_context: Any, address: Any) -> Any:
    """The word at an address; what was written before it was is seen, too."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load_atomic(place(builder, args[0]), "acquire", 8)

    return types.intp(types.intp), build


@intrinsic
def set_word(typing_context: Any, address: Any, word: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store_atomic(args[1], place(builder, args[0]), "release", 8)
        return context.get_dummy_value()

    return types.void(types.intp, types.intp), build


@intrinsic
def exchange(typing_context: Any, address: Any, old: Any, new: Any) -> Any:
    """Write `new` if the word is `old`; whether it was."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address, old, new = args
        found = builder.cmpxchg(place(builder, address), old, new, "acq_rel", "acquire")
        return builder.extract_value(found, 1)

    return types.boolean(types.intp, types.intp, types.intp), build


@intrinsic
def count_up(typing_context: Any, address: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.atomic_rmw("add", place(builder, args[0]), WORD(1), "acq_rel")
        return context.get_dummy_value()

    return types.void(types.intp), build


@jit
def put_up(board: int, turn: int) -> None:
    """All pieces of a turn, none of them finished. Only when those of the turn before are."""
    set_word(board + FINISHED, 0)
    set_word(board, turn << PIECES)


@jit
def claim(board: int, turn: int, pieces: int) -> int:
    """A piece of the turn that no other thread has; -1 if there is none.

    board 0: there is none, and no other thread.
    """
    if board == 0:
        return 0
    while True:
        ticket = look(board)
        piece: int = ticket - (turn << PIECES)
        if piece < 0 or piece >= pieces:
            return -1
        if exchange(board, ticket, ticket + 1):
            return piece


@jit
def next_piece(board: int, turn: int, pieces: int) -> int:
    """The piece after one that is done, and what was written for which is there."""
    if board == 0:
        return -1
    count_up(board + FINISHED)
    return claim(board, turn, pieces)


@jit
def wait(board: int, pieces: int, looks: int) -> bool:
    """Whether all pieces are done, looking so many times."""
    looked = 0
    while looked < looks and look(board + FINISHED) < pieces:
        looked += 1
    return looked < looks
