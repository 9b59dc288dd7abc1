# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The loop of a compiled step over the environments: each is advanced, costed and checked.

An environment is computed alone and by the same instructions whatever else is in the batch, so its
result does not depend on the batch, nor on which thread computes it.
"""

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

from numba import carray, types  # type: ignore[attr-defined, unused-ignore]

from pdeloop.jit.cache import jit
from pdeloop.jit.native import MachineCode, pointer_to
from pdeloop.jit.simd import fma, lane_sum, load, read, read_word, splat, write, write_word


@jit
def stage_cost(state: int, action: int, plan: Any, c: int) -> float:
    """q |z - z_r|^2 + r |a|^2 of one environment."""
    lanes = splat(0.0)
    whole = plan.n_z // 8 * 8
    for i in range(0, whole, 8):
        error = load(state, i) - load(c, plan.target + i)
        lanes = fma(error, error, lanes)
    state_part, action_part = lane_sum(lanes), 0.0
    for i in range(whole, plan.n_z):
        state_part += (read(state, i) - read(c, plan.target + i)) ** 2
    for j in range(plan.n_a):
        action_part += read(action, j) ** 2
    cost: float = plan.state_weight * state_part + plan.action_weight * action_part
    return cost


@jit
def accept(total: float, state: int, w: int, plan: Any) -> bool:
    """Take over the new state, if it and the costs so far are within bounds."""
    valid = math.isfinite(total)
    for j in range(plan.n_z):
        valid &= abs(read(w, plan.state + j)) <= plan.bound
    if valid:
        for j in range(plan.n_z):
            write(state, j, read(w, plan.state + j))
    return valid


def environments_of(plan: Any, advance: Callable[..., None], *sources: ModuleType) -> MachineCode:
    """Machine code that advances environments: environments(plan, states, ..., k), see below.

    plan: the dtype of the plan. advance(state, action, w, d, plan, c, e): puts the state a sampling
    time later into the scratch; it can be compiled. sources: all it is made of.
    """

    def environments(
        plans: Any,
        states: int,
        actions: int,
        totals: int,
        diverged_step: int,
        first: int,
        last: int,
        k: int,
    ) -> None:
        """Advance the environments first, ..., last - 1 in place; all but the plan are addresses.

        Adds the stage cost to `totals`. An environment whose new state is not within the bound
        keeps its state and gets k in `diverged_step`; one that has an entry there is left alone.
        """
        plan = carray(plans, 1)[0]
        w, d, c, e = plan.scratch, plan.scratch_apart, plan.constants, plan.constants_apart
        for i in range(first, last):
            if read_word(diverged_step, i) >= 0:
                continue
            state, action = states + 8 * plan.n_z * i, actions + 8 * plan.n_a * i
            total = read(totals, i) + stage_cost(state, action, plan, c)
            write(totals, i, total)
            advance(state, action, w, d, plan, c, e)
            if not accept(total, state, w, plan):
                write_word(diverged_step, i, k)

    signature = types.void(pointer_to(plan), *[types.intp] * 7)
    return MachineCode(environments, signature, advance, *sources)
