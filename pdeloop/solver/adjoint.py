# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The transpose of the step's derivative: exact gradients of whatever depends on a trajectory.

For z' = f(z, a), the compiled step of `kernel`, `Adjoint.pull_back` gives

    (df/dz)^T y    and    (df/da)^T y

for any y: the discrete adjoint of the ETDRK4 step itself, not a discretised adjoint equation. A
sampling time is integrated again from its state, g'(u) of every stage is kept, and the stages are
walked through backwards. With A(x) = F[g'(u) S x], S the field of a spectrum on the fine grid and F
the transform back (real modes of weight 2 against the first of weight 1 make F S^T and S F^T equal
up to a factor, so A is its own transpose), one internal step turns the covector x of v' into

    x_c = A_c(f3* x)
    x_b = A_b(2 f2* x + 2 Q* x_c)
    x_a = A_a(2 f2* x + Q* x_b) + E2* x_c
    x_v = A_v(f1* x + Q* (x_a - x_c)) + E2* (x_a + x_b) + E* x
    x_F = Q* (x_a + x_b + x_c) + (f1 + 4 f2 + f3)* x

with * the complex conjugate and the multiplier m inside the coefficients, as in `kernel`.

Source: Griewank & Walther, Evaluating Derivatives, SIAM 2008, chapter 3 (reverse mode); Squire &
Trapp, SIAM Review 40 (1998) (the complex step for g').
"""

import ctypes
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import carray, types  # type: ignore[attr-defined, unused-ignore]
from numba.core.errors import NumbaError
from numba.extending import register_jitable
from numpy.typing import NDArray

from pdeloop.jit import cache, native, simd
from pdeloop.jit.cache import cached_njit, jit
from pdeloop.jit.native import call_c
from pdeloop.jit.simd import load, read, splat, write
from pdeloop.messages.arrays import Array, read_only
from pdeloop.solver import fft, kernel, spectra
from pdeloop.solver.dual_math import on_duals
from pdeloop.solver.kernel import PLAN, force, internal_step
from pdeloop.solver.memory import aligned
from pdeloop.solver.spectra import (
    analyse,
    forward,
    get,
    inverse,
    minus,
    plus,
    put,
    rfft_pack,
    rfft_unpack,
    synthesise,
)
from pdeloop.solver.workers import ParallelStep

COMPLEX_STEP = 1e-30
"""g'(u) = Im g(u + i h)/h, without cancellation: h can be far below the rounding of u."""

PLAN_AND_TAPE = np.dtype(
    [
        ("derivative", np.int64),  # address of the compiled g'
        # Offsets in w.
        ("tape", np.int64),  # g' on the fine grid, four stages an internal step
        ("covector", np.int64),
        ("on_b", np.int64),
        ("on_c", np.int64),
        ("on_force", np.int64),
        # Behind, not in front: a record that begins as PLAN does would be taken for one.
        *((name, PLAN[name]) for name in PLAN.names or ()),
    ]
)


@jit
def taped(w: int, d: int, plan: Any, c: int, e: int, tape: int) -> int:
    """Like `kernel.nonlinear`, and writes g'(u) to `tape`."""
    t = plan.fine
    rfft_unpack(w, plan.x, plan.z1, d, t, c, e)
    z = inverse(w, plan.z1, plan.z2, d, t, c, e)
    for j in range(0, t.m, 8):
        put(w, tape + j, d, get(w, z + j, d))
    call_c(plan.derivative, (w + 8 * tape, t.m))
    call_c(plan.derivative, (w + 8 * (tape + d), t.m))
    call_c(plan.pointwise, (w + 8 * z, t.m))
    call_c(plan.pointwise, (w + 8 * (z + d), t.m))
    return forward(w, z, plan.z1 + plan.z2 - z, d, t, c, e)


integrate_taped = internal_step(taped)


@jit
def record(state: int, action: int, w: int, d: int, plan: Any, c: int, e: int) -> None:
    """A sampling time from a state, as `kernel.advance`, with g'(u) of every stage on the tape."""
    force(action, w, d, plan, c, e)
    analyse(state, w, d, plan, c, e)
    for n in range(plan.steps):
        integrate_taped(w, d, plan, c, e, plan.tape + n * 4 * plan.fine.m)


@jit
def conjugate_product(c: int, at: int, e: int, value: Any) -> Any:
    """Conjugate constants times a value."""
    real, imag = load(c, at), load(c, at + e)
    return real * value[0] + imag * value[1], real * value[1] - imag * value[0]


@jit
def transposed(w: int, d: int, plan: Any, c: int, e: int, tape: int) -> int:
    """Address of the transform of g'(u) times the field of the spectrum x."""
    t = plan.fine
    rfft_unpack(w, plan.x, plan.z1, d, t, c, e)
    z = inverse(w, plan.z1, plan.z2, d, t, c, e)
    for j in range(0, t.m, 8):
        u, g = get(w, z + j, d), get(w, tape + j, d)
        put(w, z + j, d, (u[0] * g[0], u[1] * g[1]))
    return forward(w, z, plan.z1 + plan.z2 - z, d, t, c, e)


def internal_pull_back(transposed: Callable[..., int]) -> Callable[..., None]:
    """The transposed internal step, compiled: pull_back_internal(w, d, plan, c, e, tape).

    transposed(w, d, plan, c, e, tape): the transform of what the nonlinear part's transposed derivative
    at the stage on the tape makes of the spectrum x.
    """

    @jit
    def pull_back_internal(w: int, d: int, plan: Any, c: int, e: int, tape: int) -> None:
        """Turn the covector of the spectrum after an internal step into that before it."""
        m, factors, modes, x = plan.fine.m, plan.fine.split, plan.modes, plan.x
        on_v, on_b, on_c = plan.covector, plan.on_b, plan.on_c
        for k in range(0, modes, 8):
            put(w, x + k, d, conjugate_product(c, plan.f3m + k, e, get(w, on_v + k, d)))
        z = transposed(w, d, plan, c, e, tape + 3 * m)
        for k in range(0, modes, 8):
            own = rfft_pack(w, z, d, m, factors, k, c, e)
            put(w, on_c + k, d, own)
            part = conjugate_product(c, plan.qm + k, e, own)
            through = conjugate_product(c, plan.f2m + k, e, get(w, on_v + k, d))
            put(w, x + k, d, plus(through, plus(part, part)))
        z = transposed(w, d, plan, c, e, tape + 2 * m)
        for k in range(0, modes, 8):
            own = rfft_pack(w, z, d, m, factors, k, c, e)
            put(w, on_b + k, d, own)
            through = conjugate_product(c, plan.f2m + k, e, get(w, on_v + k, d))
            put(w, x + k, d, plus(through, conjugate_product(c, plan.qm + k, e, own)))
        z = transposed(w, d, plan, c, e, tape + m)
        for k in range(0, modes, 8):
            b, c_, v = get(w, on_b + k, d), get(w, on_c + k, d), get(w, on_v + k, d)
            own = rfft_pack(w, z, d, m, factors, k, c, e)
            a = plus(own, conjugate_product(c, plan.e2 + k, e, c_))
            through = conjugate_product(c, plan.f1m + k, e, v)
            put(w, x + k, d, plus(through, conjugate_product(c, plan.qm + k, e, minus(a, c_))))
            held = conjugate_product(c, plan.q + k, e, plus(plus(a, b), c_))
            held = plus(held, conjugate_product(c, plan.f + k, e, v))
            put(w, plan.on_force + k, d, plus(get(w, plan.on_force + k, d), held))
            linear = conjugate_product(c, plan.e2 + k, e, plus(a, b))
            put(w, on_v + k, d, plus(linear, conjugate_product(c, plan.e + k, e, v)))
        z = transposed(w, d, plan, c, e, tape)
        for k in range(0, modes, 8):
            put(w, on_v + k, d, plus(get(w, on_v + k, d), rfft_pack(w, z, d, m, factors, k, c, e)))

    return pull_back_internal


pull_back_internal = internal_pull_back(transposed)


@cached_njit(cache, native, simd, fft, spectra, kernel)
def pull_back(
    states: Array,
    actions: Array,
    covectors: Array,
    after: Array,
    on_states: Array,
    on_actions: Array,
    plans: NDArray[np.void],
) -> None:
    """Write `after`, f(z, a), and `on_states` and `on_actions`, the transposed products."""
    plan = plans[0]
    w, d, c, e = plan.scratch, plan.scratch_apart, plan.constants, plan.constants_apart
    last, block = plan.n_z // 2, 4 * plan.fine.m
    for i in range(len(states)):
        state = states.ctypes.data + 8 * plan.n_z * i
        record(state, actions.ctypes.data + 8 * plan.n_a * i, w, d, plan, c, e)
        synthesise(after.ctypes.data + 8 * plan.n_z * i, w, d, plan, c, e)
        # Synthesis transposed is analysis, but for the last mode, of weight 1 on the published
        # grid and 2 on the fine one.
        analyse(covectors.ctypes.data + 8 * plan.n_z * i, w, d, plan, c, e)
        for k in range(0, plan.modes, 8):
            put(w, plan.covector + k, d, get(w, plan.x + k, d))
            put(w, plan.on_force + k, d, (splat(0.0), splat(0.0)))
        write(w, plan.covector + last, 0.5 * read(w, plan.covector + last))
        write(w, plan.covector + d + last, 0.0)
        for n in range(plan.steps - 1, -1, -1):
            pull_back_internal(w, d, plan, c, e, plan.tape + n * block)
        for j in range(plan.n_a):
            at, total = plan.supports + j * plan.modes, 0.0
            for k in range(last + 1):
                own = read(w, plan.on_force + k) * read(c, at + k)
                own += read(w, plan.on_force + d + k) * read(c, at + e + k)
                total += own if k == 0 else 2.0 * own
            on_actions[i, j] = plan.n_z * total
        for k in range(last + 1):
            write(w, plan.x + k, read(w, plan.covector + k))
            write(w, plan.x + d + k, read(w, plan.covector + d + k))
        for k in range(last + 1, plan.modes):
            write(w, plan.x + k, 0.0)
            write(w, plan.x + d + k, 0.0)
        write(w, plan.x + last, 2.0 * read(w, plan.x + last))
        synthesise(on_states.ctypes.data + 8 * plan.n_z * i, w, d, plan, c, e)


class Adjoint:
    """Gradients through the compiled step of a semilinear equation.

    Parameters
    ----------
    step
        As for `kernel.etdrk4_step`; it is not changed.
    nonlinearity
        Its g.

    Raises
    ------
    ValueError
        The nonlinearity has no derivative that can be computed.
    """

    def __init__(self, step: ParallelStep, nonlinearity: Callable[[float], float]) -> None:
        self._constants = step.constants  # kept alive: the plan has its address
        self._loop = derivative_loop(nonlinearity)
        self._plans = np.zeros(1, PLAN_AND_TAPE)
        plan = self._plans[0]
        for name in PLAN.names or ():
            plan[name] = step.plans[0][name]
        offset = int(plan["scratch_apart"])
        sizes = {"tape": 4 * int(plan["steps"]) * int(plan["fine"]["m"])}
        sizes |= dict.fromkeys(("covector", "on_b", "on_c", "on_force"), plan["modes"])
        for name, size in sizes.items():
            plan[name] = offset
            offset += int(size)
        plan["scratch_apart"], plan["derivative"] = offset, self._loop.address
        self._scratch = aligned(2 * offset)
        plan["scratch"] = self._scratch.ctypes.data

    def step(self, states: Array, actions: Array) -> Array:
        """f(z, a) as it is recorded for the way back: the step itself, to the bit.

        Whatever diverges is not held back, as the step does.
        """
        return self._run(states, actions, np.zeros_like(states))[0]

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        """(df/dz)^T y and (df/da)^T y of every environment, (M, n_z) and (M, n_a).

        states (M, n_z): one whose successor diverges gives numbers of no meaning; actions (M, n_a):
        held for a sampling time; covectors (M, n_z): y. ValueError for shapes that do not fit.
        """
        return self._run(states, actions, covectors)[1:]

    def _run(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array, Array]:
        z, a, y = (read_only(x) for x in (states, actions, covectors))
        batch, plan = len(z), self._plans[0]
        for what, given, size in (("states", z, plan["n_z"]), ("actions", a, plan["n_a"])):
            if given.shape != (batch, size):
                raise ValueError(f"{what} must have shape ({batch}, {size}), got {given.shape}")
        if y.shape != z.shape:
            raise ValueError(f"covectors must have the states' shape {z.shape}, got {y.shape}")
        after, on_states, on_actions = np.empty_like(z), np.empty_like(z), np.empty_like(a)
        pull_back(z, a, y, after, on_states, on_actions, self._plans)
        return after, on_states, on_actions


class LinearAdjoint:
    """The same of a step that is linear, z' = A z + B a: A^T y and B^T y.

    A_transposed: (n_z, n_z); B_transposed: (n_a, n_z).
    """

    def __init__(self, A_transposed: Array, B_transposed: Array) -> None:
        self._A_transposed, self._B_transposed = A_transposed, B_transposed

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        """A^T y and B^T y of every environment, (M, n_z) and (M, n_a)."""
        return covectors @ self._A_transposed.T, covectors @ self._B_transposed.T


def derivative_loop(nonlinearity: Callable[[float], float]) -> Any:
    """Machine code of u[i] = g'(u[i]), a cfunc of (double *, intp), by the complex step.

    ValueError if g does not compile for a complex number, or is not analytic (|u|, max, ...): then the
    complex step does not agree with a finite difference. The functions of `math` do compile
    (`pdeloop.solver.dual_math`).
    """
    g: Any = register_jitable(error_model="numpy")(on_duals(nonlinearity))
    signature = types.void(types.CPointer(types.float64), types.intp)  # type: ignore[no-untyped-call]
    try:

        @numba.cfunc(signature)
        def loop(data: Any, count: int) -> None:
            u = carray(data, count)
            for i in range(count):
                u[i] = g(complex(u[i], COMPLEX_STEP)).imag / COMPLEX_STEP

    except (NumbaError, NotImplementedError) as error:  # the latter of what has no order, as max
        reason = str(error).strip().splitlines()[-1]
        raise ValueError(
            f"the nonlinearity {nonlinearity.__qualname__} has no derivative by the complex step; it "
            f"must be one expression that Numba compiles for a complex number: {reason}"
        ) from error
    points = np.linspace(-2.03, 2.01, 41)
    slopes = points.copy()
    loop.ctypes(slopes.ctypes.data_as(ctypes.POINTER(ctypes.c_double)), slopes.size)
    h = 1e-5
    finite = np.array([_slope(nonlinearity, u, h) for u in points.tolist()])
    known = np.isfinite(finite)  # where g is defined, as log(u) is not everywhere
    wrong = np.abs(slopes - finite)[known].max(initial=0.0)
    if not wrong <= 1e-5 * np.abs(finite[known]).max(initial=0.0):
        raise ValueError(
            f"the nonlinearity {nonlinearity.__qualname__} is not an analytic function of u, so "
            "the complex step cannot differentiate it; gradients need one without |u|, max, min "
            "or branches"
        )
    return loop


def _slope(function: Callable[[float], float], u: float, h: float) -> float:
    """Its finite difference; NaN where it is not defined."""
    try:
        with np.errstate(all="ignore"):
            return (function(u + h) - function(u - h)) / (2 * h)
    except (ValueError, ArithmeticError):
        return float("nan")
