# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A step of a batch as compiled code, with all that it works on in one record."""

from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined, unused-ignore]

from loop_interfaces.jit import native
from loop_interfaces.jit.cache import jit
from loop_interfaces.jit.native import call_c, machine_code, pointer_to

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


@machine_code(types.void(pointer_to(STEP_CONTEXT)), native)
def step_code(contexts: Any) -> None:
    """Advance all environments of a STEP_CONTEXT."""
    context = carray(contexts, 1)[0]
    advance(context, context.plan, 0, context.batch)
    context.step += 1
