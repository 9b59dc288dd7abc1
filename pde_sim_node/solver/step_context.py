"""A step of a plant as compiled code alone: by one thread, or shared with workers that poll a queue."""

from typing import Any

import numba
import numpy as np
from numba import carray, types  # type: ignore[attr-defined, unused-ignore]

from loop_interfaces.jit import atomics, native
from loop_interfaces.jit.cache import fingerprint, jit
from loop_interfaces.jit.native import MachineCode, call_c
from pde_sim_node.solver import work_queue
from pde_sim_node.solver.work_queue import begin_turn, claim, current_turn, finish, wait_until_done

SPINS = 1_000_000

STEP_CONTEXT = np.dtype(
    [
        # Addresses.
        ("code", np.int64),  # see batch_step.environments_of for what it is called with
        ("plan", np.int64),
        ("queue", np.int64),
        ("states", np.int64),
        ("actions", np.int64),
        ("totals", np.int64),
        ("diverged_step", np.int64),
        # Numbers. Batch and slices only change while the queue is closed.
        ("batch", np.int64),
        ("slices", np.int64),
        ("step", np.int64),  # k, of the states
        ("shared", np.int64),  # 0: the calling thread does the whole step
        ("polling", np.int64),  # whether the workers stay and wait for the next step
    ]
)


@jit
def advance(context: Any, plan: int, first: int, last: int) -> None:
    """Advance the environments first, ..., last - 1, with the scratch of a plan."""
    z, a, c, ended = context.states, context.actions, context.totals, context.diverged_step
    call_c(context.code, (plan, z, a, c, ended, first, last, context.step))


@jit
def advance_slices(context: Any, plan: int) -> None:
    """Advance the environments of those slices of the present turn that no other thread has."""
    # The turn first: what is read afterwards is of this turn, or no slice of it is left.
    queue, turn = context.queue, current_turn(context.queue)
    slices, batch = context.slices, context.batch
    index = claim(queue, turn, slices)
    while index >= 0:
        advance(context, plan, batch * index // slices, batch * (index + 1) // slices)
        finish(queue)
        index = claim(queue, turn, slices)


@jit
def take_slices(context: Any, plan: int) -> None:
    """Take slices of a step, and of every later one as long as the workers poll."""
    advance_slices(context, plan)
    while context.polling != 0:
        advance_slices(context, plan)


@jit
def step_environments(context: Any) -> None:
    """Advance all environments by one step."""
    if context.shared == 0:
        advance(context, context.plan, 0, context.batch)
    else:
        begin_turn(context.queue)
        advance_slices(context, context.plan)
        while not wait_until_done(context.queue, context.slices, SPINS):
            pass
    context.step += 1


def compile_step() -> Any:
    sources = fingerprint(work_queue, atomics, native)
    contexts_at = types.CPointer(numba.from_dtype(STEP_CONTEXT))  # type: ignore[no-untyped-call]

    @numba.cfunc(types.void(contexts_at), cache=True)
    def step(contexts: Any) -> None:
        sources  # noqa: B018  # closed over to be part of the key on disk
        step_environments(carray(contexts, 1)[0])

    return step


step_code = MachineCode(compile_step)
"""A step as a C function of the address of a STEP_CONTEXT."""
