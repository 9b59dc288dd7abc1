"""A step of a plant as compiled code alone: by one thread, or shared with workers that poll a queue."""

from typing import Any

import numpy as np

from loop_interfaces.jit.cache import jit
from loop_interfaces.jit.native import call_c
from pde_sim_node.solver.work_queue import (
    MAX_TURN,
    begin_turn,
    claim,
    current_turn,
    finish_and_claim,
    wait_until_done,
)

__all__ = ["SPINS", "STEP_CONTEXT", "advance_slices", "help_with_steps", "step_environments"]

SPINS = 1_000_000

STEP_CONTEXT = np.dtype(
    [
        # Addresses, but for the numbers of environments and of slices.
        ("code", np.int64),  # see batch_step.environments_of for what it is called with
        ("plan", np.int64),
        ("queue", np.int64),  # 0 where nobody helps
        ("slices", np.int64),
        ("states", np.int64),
        ("actions", np.int64),
        ("totals", np.int64),
        ("diverged_step", np.int64),
        ("batch", np.int64),
        ("step", np.int64),  # k, of the states
        ("turn", np.int64),  # of the queue
        ("over", np.int64),  # whether the workers may go
    ]
)


@jit
def advance_slices(
    code: int,
    plan: int,
    states: int,
    actions: int,
    totals: int,
    diverged_step: int,
    k: int,
    batch: int,
    queue: int,
    turn: int,
    slices: int,
) -> None:
    """Advance the environments of those slices of the turn that no other thread has; of the only one
    without a queue.
    """
    index = claim(queue, turn, slices)
    while index >= 0:
        first, last = batch * index // slices, batch * (index + 1) // slices
        call_c(code, (plan, states, actions, totals, diverged_step, first, last, k))
        index = finish_and_claim(queue, turn, slices)


@jit
def advance_turn(context: Any, plan: int, turn: int) -> None:
    advance_slices(
        context.code,
        plan,
        context.states,
        context.actions,
        context.totals,
        context.diverged_step,
        context.step,
        context.batch,
        context.queue,
        turn,
        context.slices,
    )


@jit
def step_environments(context: Any) -> None:
    """Advance all environments by one step."""
    queue = context.queue
    if queue != 0:
        context.turn = (context.turn + 1) & (MAX_TURN - 1)
        begin_turn(queue, context.turn)
    advance_turn(context, context.plan, context.turn)
    while queue != 0 and not wait_until_done(queue, context.slices, SPINS):
        pass
    context.step += 1


@jit
def help_with_steps(context: Any, plan: int) -> None:
    """Take slices of every step until it is over, with a plan of one's own."""
    while context.over == 0:
        advance_turn(context, plan, current_turn(context.queue))
