"""A step of a batch as compiled code, with all that it works on in one record."""

from typing import Any

import numba
import numpy as np
from numba import carray, types  # type: ignore[attr-defined, unused-ignore]

from loop_interfaces.jit import native
from loop_interfaces.jit.cache import fingerprint, jit
from loop_interfaces.jit.native import MachineCode, call_c

STEP_CONTEXT = np.dtype(
    [
        # Addresses.
        ("code", np.int64),  # see batch_step.environments_of for what it is called with
        ("plan", np.int64),
        ("states", np.int64),
        ("actions", np.int64),
        ("totals", np.int64),
        ("diverged_step", np.int64),
        # Numbers.
        ("batch", np.int64),
        ("step", np.int64),  # k, of the states
    ]
)


@jit
def advance(context: Any, plan: int, first: int, last: int) -> None:
    """Advance the environments first, ..., last - 1, with the scratch of a plan."""
    z, a, c, ended = context.states, context.actions, context.totals, context.diverged_step
    call_c(context.code, (plan, z, a, c, ended, first, last, context.step))


def compile_step() -> Any:
    """The compiled `advance` of a whole batch, at an address that other compiled code calls."""
    contexts_at = types.CPointer(numba.from_dtype(STEP_CONTEXT))  # type: ignore[no-untyped-call]
    sources = fingerprint(native)

    @numba.cfunc(types.void(contexts_at), cache=True)
    def step(contexts: Any) -> None:
        sources  # noqa: B018  # closed over to be part of the key on disk
        context = carray(contexts, 1)[0]
        advance(context, context.plan, 0, context.batch)
        context.step += 1

    return step


step_code = MachineCode(compile_step)
"""A step of all environments as a C function of the address of a STEP_CONTEXT."""
