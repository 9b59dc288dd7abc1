# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Many sampling times of a polynomial equation under a feedback, and the adjoint of all of them.

    [r_i; u_i] = K [z_i; p_i] + b + v_i,        a_i = clip(r_i, low, high),
    z_{i+1} = f(z_i, a_i) + e_i,                p_{i+1} = u_i + B a_i,

with p the memory of the feedback, if it has one, in one compiled call; and from derivatives by states
and actions, backwards, those by v_i in another. What the step keeps of its stages stays on a tape
between the two, so that nothing is computed twice. The step is that of `polynomial_step`; of several
equations that differ in their internal steps the first one acts whose reach contains the field.

References
----------
Griewank, Walther, "Evaluating Derivatives", SIAM 2008, chapter 3 (reverse mode).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pdeloop.jit.cache import cached_njit, jit
from pdeloop.jit.simd import WIDTH, fma, lane_sum, load, read, splat, store, write
from pdeloop.messages.arrays import Array, read_only
from pdeloop.solver import polynomial
from pdeloop.solver.kernel import force
from pdeloop.solver.memory import aligned
from pdeloop.solver.polynomial import PLAN, SOURCES, by_action, integrate, pull_back_internal
from pdeloop.solver.polynomial_step import Polynomials, PolynomialStep
from pdeloop.solver.spectra import analyse, get, put, synthesise

MAGNITUDE = 2**63 - 1
"""The bits of a number but for its sign."""


@jit
def dot(a: int, b: int, n: int) -> float:
    """The inner product of the n numbers at two addresses, n a multiple of eight."""
    total = splat(0.0)
    for x in range(0, n, 8):
        total = fma(load(a, x), load(b, x), total)
    found: float = lane_sum(total)
    return found


@cached_njit(*SOURCES, polynomial)
def roll(
    v: Array, feedback: Array, constant: Array, B: Array, e: Array, bounds: Array,
    reach: NDArray[np.int64], kept: int, plans: NDArray[np.void], levels: NDArray[np.int64],
    states: Array, requested: Array, actions: Array,
) -> None:  # fmt: skip
    """Write [z; p] (H + 1, n_x + n_p) from the first of them, [r; u] (H, n_a + n_p) and [a; 1].

    reach: words of the numbers; B (n_p, n_a); e (H, n_x), or no row; kept: 1, or 0 without a tape;
    actions (H, n_a + 1).
    """
    H, (n_p, n_a), n = len(v), B.shape, states.shape[1]
    n_x, words = n - n_p, states.view(np.int64)
    for i in range(H):
        largest, level, state = 0, 0, states.ctypes.data + 8 * n * i
        for x in range(n_x):  # magnitudes are ordered as their words are, with NaN behind infinity
            largest = max(largest, words[i, x] & MAGNITUDE)
        while level < reach.size and largest > reach[level]:
            level += 1
        levels[i] = level
        for j in range(n_a + n_p):
            total = constant[j] + v[i, j] + dot(feedback.ctypes.data + 8 * n * j, state, n_x)
            for x in range(n_x, n):
                total += feedback[j, x] * states[i, x]
            requested[i, j] = total
        for j in range(n_a):
            actions[i, j] = min(max(requested[i, j], bounds[0, j]), bounds[1, j])
        actions[i, n_a] = 1.0
        for m in range(n_p):
            total = requested[i, n_a + m]
            for j in range(n_a):
                total += B[m, j] * actions[i, j]
            states[i + 1, n_x + m] = total
        plan = plans[level]
        w, d, c, apart = plan.scratch, plan.scratch_apart, plan.constants, plan.constants_apart
        block = kept * 4 * plan.fine.m
        tape = plan.tape + i * plan.steps * block
        if i == 0 or len(e) or level != levels[i - 1]:  # else the spectrum is there
            analyse(state, w, d, plan, c, apart)
        force(actions.ctypes.data + 8 * (n_a + 1) * i, w, d, plan, c, apart)
        for s in range(plan.steps):
            integrate(w, d, plan, c, apart, tape + s * block)
        synthesise(state + 8 * n, w, d, plan, c, apart)
        if len(e):
            for x in range(n_x):
                states[i + 1, x] += e[i, x]


@cached_njit(*SOURCES, polynomial)
def roll_back(
    free: Array, on_states: Array, on_actions: Array, feedback: Array, B: Array,
    plans: NDArray[np.void], levels: NDArray[np.int64], eta: Array, found: Array,
) -> None:  # fmt: skip
    """Write the derivatives (H, n_a + n_p) by v; eta (n_x + n_p,): that by the last state, overwritten.

    free (H, n_a): 1, or 0 where an action does not depend on what is requested.
    """
    H, (n_p, n_a), n = len(found), B.shape, eta.size
    n_x = n - n_p
    last, even = n_x // 2, n_x % 2 == 0
    for i in range(H - 1, -1, -1):
        plan = plans[levels[i]]
        w, d, c, apart = plan.scratch, plan.scratch_apart, plan.constants, plan.constants_apart
        block = 4 * plan.fine.m
        tape = plan.tape + i * plan.steps * block
        analyse(eta.ctypes.data, w, d, plan, c, apart)
        for k in range(0, plan.modes, 8):
            put(w, plan.covector + k, d, get(w, plan.x + k, d))
            put(w, plan.on_force + k, d, (splat(0.0), splat(0.0)))
        if even:  # as in `PolynomialStep.pull_back`
            write(w, plan.covector + last, 0.5 * read(w, plan.covector + last))
            write(w, plan.covector + d + last, 0.0)
        for s in range(plan.steps - 1, -1, -1):
            pull_back_internal(w, d, plan, c, apart, tape + s * block)
        for k in range(0, plan.modes, 8):
            put(w, plan.x + k, d, get(w, plan.covector + k, d))
        if even:
            write(w, plan.x + last, 2.0 * read(w, plan.x + last))
        for j in range(n_a):
            total = by_action(j, w, d, plan, c, apart) + on_actions[i, j]
            for m in range(n_p):
                total += B[m, j] * eta[n_x + m]
            found[i, j] = total * free[i, j]
        for m in range(n_p):
            found[i, n_a + m] = eta[n_x + m]
        synthesise(eta.ctypes.data, w, d, plan, c, apart)
        for x in range(0, n_x, 8):
            lanes = load(on_states.ctypes.data, n * i + x) + load(eta.ctypes.data, x)
            for j in range(n_a + n_p):
                lanes = fma(splat(found[i, j]), load(feedback.ctypes.data, n * j + x), lanes)
            store(eta.ctypes.data, x, lanes)
        for x in range(n_x, n):
            total = on_states[i, x]
            for j in range(n_a + n_p):
                total += feedback[j, x] * found[i, j]
            eta[x] = total


class PolynomialSweep:
    """The two for one equation, or several that differ in their internal steps.

    One thread may use it at a time.

    Parameters
    ----------
    steps : sequence of PolynomialStep
        Those for small fields first; all of them on a grid whose length has a compiled transform.
    reach : (n,) array
        The largest magnitude of a field for each but the last.
    horizon : int
        Most sampling times H.
    """

    def __init__(self, steps: Sequence[PolynomialStep], reach: Array, horizon: int) -> None:
        self._steps = tuple(steps)  # alive: plans have addresses
        self._reach = read_only(reach).view(np.int64)
        self._plans, self._scratch = np.zeros(len(steps), PLAN), list[Array]()
        for i, step in enumerate(steps):
            plan = step.plan.copy()
            stages = 4 * int(plan["steps"]) * int(plan["fine"]["m"])
            apart = int(plan["scratch_apart"]) + (horizon - 1) * stages  # the tape comes last
            self._scratch.append(aligned(2 * apart))
            plan["scratch"], plan["scratch_apart"] = self._scratch[-1].ctypes.data, apart
            self._plans[i] = plan
        self._levels = np.zeros(horizon, dtype=np.int64)

    def roll(
        self,
        z: Array,
        v: Array,
        feedback: Array,
        constant: Array,
        bounds: Array,
        *,
        B: Array | None = None,
        e: Array | None = None,
        kept: bool = True,
    ) -> tuple[Array, Array, Array]:
        """States [z; p] (H + 1, n_x + n_p) from [z_0; p_0], requested [r; u] and applied actions a.

        v (H, n_a + n_p), feedback K (n_a + n_p, n_x + n_p), constant b (n_a + n_p,), bounds (2, n_a), B
        (n_p, n_a) or None without a memory, e (H, n_x) or None; kept: whether `roll_back` will follow.
        """
        H, n_a = len(v), bounds.shape[1]
        B, e = (np.zeros((0, n)) if x is None else x for n, x in ((n_a, B), (len(z), e)))
        states, requested = np.empty((H + 1, len(z))), np.empty(v.shape)
        actions = np.empty((H, n_a + 1))
        states[0] = z
        first = read_only(v), read_only(feedback), read_only(constant), read_only(B), read_only(e)
        given = *first, read_only(bounds), self._reach, int(kept)
        roll(*given, self._plans, self._levels, states, requested, actions)
        return states, requested, actions[:, :-1]

    def roll_back(
        self,
        free: Array,
        on_states: Array,
        on_actions: Array,
        feedback: Array,
        eta: Array,
        *,
        B: Array | None = None,
    ) -> Array:
        """Derivatives (H, n_a + n_p) by v of the last `roll`, of a function of its states and actions.

        free (H, n_a): 1, or 0 where an action is at a bound; on_states (H, n_x + n_p) and on_actions
        (H, n_a): its derivatives by [z_i; p_i] and a_i, i < H; eta (n_x + n_p,): that by the last.
        """
        B = np.zeros((0, free.shape[1])) if B is None else B
        found, last = np.empty((len(free), len(feedback))), np.array(eta)
        slopes = read_only(free), read_only(on_states), read_only(on_actions)
        roll_back(
            *slopes, read_only(feedback), read_only(B), self._plans, self._levels, last, found
        )
        return found


def load_compiled() -> None:
    """Load both ways, or compile them."""
    n_x = 2 * WIDTH  # the least size whose spectra are compiled
    none, z, a = np.zeros(n_x // 2 + 1, dtype=np.complex128), np.zeros(n_x), np.zeros((1, 1))
    equation = Polynomials(none, none[None], np.ones((1, 1)), np.zeros((n_x, 1)), z, 1, np.inf)
    sweep, feedback = PolynomialSweep([PolynomialStep(equation)], np.zeros(0), 1), z[None]
    sweep.roll(z, a, feedback, a[0], np.zeros((2, 1)))
    sweep.roll_back(a, feedback, a, feedback, z)
