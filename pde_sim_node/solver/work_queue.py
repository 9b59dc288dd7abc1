"""The slices of a step in a queue, from which the threads take them, inside compiled functions.

Two words of memory: the ticket, turn * 2^32 + the next slice, and how many slices are finished. Both
only change in one instruction each, and a ticket of another turn is no ticket: a thread that wakes up
late, when the next step has begun already, takes nothing of it.
"""

from loop_interfaces.jit.atomics import compare_exchange, fetch_add, load_acquire, store_release
from loop_interfaces.jit.cache import jit

QUEUE_WORDS = 16
"""Words of a queue: the two that are used, each on a cache line of its own."""
MAX_TURN = 2**31
SLICE_BITS = 32
CLOSED = 2**31
FINISHED = 64
"""Bytes from the ticket to the count."""


@jit
def current_turn(queue: int) -> int:
    turn: int = load_acquire(queue) >> SLICE_BITS
    return turn


@jit
def begin_turn(queue: int) -> None:
    """Offer all slices of the next turn, none of them finished. Only when those of this one are."""
    turn = (current_turn(queue) + 1) & (MAX_TURN - 1)
    store_release(queue + FINISHED, 0)
    store_release(queue, turn << SLICE_BITS)


@jit
def close(queue: int) -> None:
    """Offer no slices until the next turn. Only when those of this one are finished."""
    store_release(queue, (current_turn(queue) << SLICE_BITS) | CLOSED)


@jit
def claim(queue: int, turn: int, slices: int) -> int:
    """A slice of the turn that no other thread has; -1 if there is none."""
    while True:
        ticket = load_acquire(queue)
        index: int = ticket - (turn << SLICE_BITS)
        if index < 0 or index >= slices:
            return -1
        if compare_exchange(queue, ticket, ticket + 1):
            return index


@jit
def finish(queue: int) -> None:
    """A slice that was claimed is done; what was written for it is visible to who waits."""
    fetch_add(queue + FINISHED, 1)


@jit
def wait_until_done(queue: int, slices: int, spins: int) -> bool:
    """Whether all slices are finished, polling so many times."""
    polled = 0
    while polled < spins and load_acquire(queue + FINISHED) < slices:
        polled += 1
    return polled < spins
