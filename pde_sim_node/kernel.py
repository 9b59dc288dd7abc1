"""The compiled step of the plant: ETDRK4 for one environment after the other.

An environment is computed alone and by the same instructions whatever stands beside it, so its
result does not depend on the batch, nor on which thread computes it.

With N = m F[g(u)] + F_a the nonlinear part and the forcing of a held action, one internal step is

    a = E2 v + Q N(v)
    b = E2 v + Q N(a)
    c = E2 a + Q (2 N(b) - N(v))
    v' = E v + f1 N(v) + 2 f2 (N(a) + N(b)) + f3 N(c).

F_a does not change within a step, so its parts Q F_a and (f1 + 4 f2 + f3) F_a are worked out once;
the multiplier m is contained in the coefficients (names with an m).
"""

import math
from typing import Any

import numba
import numpy as np
from numba import carray, types  # type: ignore[attr-defined, unused-ignore]
from numpy.typing import NDArray

from loop_interfaces import simd
from loop_interfaces.compiled import fingerprint, jit, kept
from loop_interfaces.native import MachineCode
from loop_interfaces.simd import call, fma, load, read, read_word, splat, store, write, write_word

from . import fft, spectra
from .spectra import (
    TRANSFORM,
    analyse,
    forward,
    get,
    inverse,
    joined,
    minus,
    plus,
    plus_product,
    product,
    put,
    split,
    synthesise,
)

__all__ = ["PLAN", "accept", "all_finite", "environments", "stage_cost", "step_signature"]

PLAN = np.dtype(
    [
        ("constants", np.int64),  # address of c
        ("constants_apart", np.int64),  # distance e of its planes
        ("scratch", np.int64),  # address of w
        ("scratch_apart", np.int64),  # distance d of its planes
        ("pointwise", np.int64),  # address of the compiled nonlinearity
        ("n_x", np.int64),  # grid points
        ("n_z", np.int64),  # size of the state, the same
        ("n_a", np.int64),
        ("steps", np.int64),  # internal steps of a sampling time
        ("modes", np.int64),  # n_z//2 + 1, up to whole lanes
        ("fine", TRANSFORM),  # of the dealiased grid
        ("coarse", TRANSFORM),  # of the published grid
        ("state_weight", np.float64),
        ("action_weight", np.float64),
        ("bound", np.float64),
        # Offsets in c.
        ("e", np.int64),
        ("e2", np.int64),
        ("q", np.int64),
        ("qm", np.int64),
        ("f1m", np.int64),
        ("f2m", np.int64),  # twice f2
        ("f3m", np.int64),
        ("f", np.int64),  # f1 + 4 f2 + f3
        ("supports", np.int64),  # their spectra, n_a by modes
        ("target", np.int64),
        ("analysis", np.int64),  # matrices of the coarse transform, n_z by modes
        ("synthesis", np.int64),
        # Offsets in w.
        ("x", np.int64),  # the spectrum to be transformed next, zero above the modes
        ("z1", np.int64),
        ("z2", np.int64),
        ("next", np.int64),
        ("b", np.int64),
        ("c", np.int64),
        ("qf", np.int64),
        ("ff", np.int64),
        ("state", np.int64),
    ]
)


def step_signature(plan: Any) -> Any:
    """Of the machine code that advances environments: its plan, and seven addresses and numbers."""
    plans = types.CPointer(numba.from_dtype(plan))  # type: ignore[no-untyped-call]
    return types.void(plans, *[types.intp] * 7)


@jit
def nonlinear(w: int, d: int, plan: Any, c: int, e: int) -> int:
    """Where the transform of g(u) stands, u being the field of the spectrum x on the fine grid."""
    t = plan.fine
    split(w, plan.x, plan.z1, d, t, c, e)
    z = inverse(w, plan.z1, plan.z2, d, t, c, e)
    call(plan.pointwise, w, z, t.m)
    call(plan.pointwise, w, z + d, t.m)
    return forward(w, z, plan.z1 + plan.z2 - z, d, t, c, e)


@jit
def integrate(w: int, d: int, plan: Any, c: int, e: int) -> None:
    """One internal step of the spectrum x."""
    # Read here, as the compiler cannot know that what is stored below is not the plan.
    m, factors, modes = plan.fine.m, plan.fine.split, plan.modes
    x, next_x, to_b, to_c = plan.x, plan.next, plan.b, plan.c
    e1, e2, qm, f2m = plan.e, plan.e2, plan.qm, plan.f2m
    f1m, f3m, qfs, ffs = plan.f1m, plan.f3m, plan.qf, plan.ff
    z = nonlinear(w, d, plan, c, e)
    for k in range(0, modes, 8):
        g, v, qf = joined(w, z, d, m, factors, k, c, e), get(w, x + k, d), get(w, qfs + k, d)
        half, qg = plus_product(qf, c, e2 + k, e, v), product(c, qm + k, e, g)
        a = plus(half, qg)
        put(w, x + k, d, a)
        put(w, to_b + k, d, half)
        put(w, to_c + k, d, minus(plus_product(qf, c, e2 + k, e, a), qg))
        whole = plus_product(get(w, ffs + k, d), c, e1 + k, e, v)
        put(w, next_x + k, d, plus_product(whole, c, f1m + k, e, g))
    z = nonlinear(w, d, plan, c, e)
    for k in range(0, modes, 8):
        g = joined(w, z, d, m, factors, k, c, e)
        put(w, x + k, d, plus_product(get(w, to_b + k, d), c, qm + k, e, g))
        put(w, next_x + k, d, plus_product(get(w, next_x + k, d), c, f2m + k, e, g))
    z = nonlinear(w, d, plan, c, e)
    for k in range(0, modes, 8):
        g = joined(w, z, d, m, factors, k, c, e)
        qg = product(c, qm + k, e, g)
        put(w, x + k, d, plus(get(w, to_c + k, d), plus(qg, qg)))
        put(w, next_x + k, d, plus_product(get(w, next_x + k, d), c, f2m + k, e, g))
    z = nonlinear(w, d, plan, c, e)
    for k in range(0, modes, 8):
        g = joined(w, z, d, m, factors, k, c, e)
        put(w, x + k, d, plus_product(get(w, next_x + k, d), c, f3m + k, e, g))


@jit
def force(action: int, w: int, d: int, plan: Any, c: int, e: int) -> None:
    """Q F_a and (f1 + 4 f2 + f3) F_a of an action."""
    for k in range(0, plan.modes, 8):
        total = splat(0.0), splat(0.0)
        for j in range(plan.n_a):
            a = splat(read(action, j))
            support = get(c, plan.supports + j * plan.modes + k, e)
            total = fma(a, support[0], total[0]), fma(a, support[1], total[1])
        put(w, plan.qf + k, d, product(c, plan.q + k, e, total))
        put(w, plan.ff + k, d, product(c, plan.f + k, e, total))


@jit
def stage_cost(state: int, action: int, w: int, plan: Any, c: int) -> float:
    lanes = splat(0.0)
    whole = plan.n_z // 8 * 8
    for i in range(0, whole, 8):
        error = load(state, i) - load(c, plan.target + i)
        lanes = fma(error, error, lanes)
    store(w, plan.next, lanes)
    state_part, action_part = 0.0, 0.0
    for i in range(8):
        state_part += read(w, plan.next + i)
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


def compile_environments() -> Any:
    sources = fingerprint(simd, fft, spectra)

    @numba.cfunc(step_signature(PLAN), cache=True)
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
        sources  # noqa: B018  # closed over to be part of the key on disk
        plan = carray(plans, 1)[0]
        w, d, c, e = plan.scratch, plan.scratch_apart, plan.constants, plan.constants_apart
        for i in range(first, last):
            if read_word(diverged_step, i) >= 0:
                continue
            state, action = states + 8 * plan.n_z * i, actions + 8 * plan.n_a * i
            total = read(totals, i) + stage_cost(state, action, w, plan, c)
            write(totals, i, total)
            force(action, w, d, plan, c, e)
            analyse(state, w, d, plan, c, e)
            for _ in range(plan.steps):
                integrate(w, d, plan, c, e)
            synthesise(w + 8 * plan.state, w, d, plan, c, e)
            if not accept(total, state, w, plan):
                write_word(diverged_step, i, k)

    return environments


environments = MachineCode(compile_environments)


@kept
def all_finite(values: NDArray[np.float64]) -> bool:
    finite = True
    for value in values.flat:
        finite &= math.isfinite(value)
    return finite
