# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The compiled step of the plant: ETDRK4 for one environment after the other.

With N = m F[g(u)] + F_a the nonlinear part and the forcing of a held action, one internal step is

    a = E2 v + Q N(v)
    b = E2 v + Q N(a)
    c = E2 a + Q (2 N(b) - N(v))
    v' = E v + f1 N(v) + 2 f2 (N(a) + N(b)) + f3 N(c).

F_a does not change within a step, so its parts Q F_a and (f1 + 4 f2 + f3) F_a are worked out once;
the multiplier m is contained in the coefficients (names with an m).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from pdeloop.jit import native, simd
from pdeloop.jit.cache import jit, jit_in_closure
from pdeloop.jit.native import call_c
from pdeloop.jit.simd import WIDTH, fma, read, splat, whole_lanes
from pdeloop.solver import fft, spectra
from pdeloop.solver.batch_step import environments_of
from pdeloop.solver.etdrk4 import etdrk4_coefficients
from pdeloop.solver.fft import is_transform_length, plane_size
from pdeloop.solver.memory import Constants, StepSettings, begin_plan, lay_out, step_plan_type
from pdeloop.solver.pointwise import pointwise_loop
from pdeloop.solver.spectra import (
    TRANSFORM,
    analyse,
    forward,
    get,
    inverse,
    minus,
    plus,
    plus_product,
    product,
    put,
    rfft_pack,
    rfft_unpack,
    synthesise,
)
from pdeloop.solver.workers import ParallelStep

PLAN = step_plan_type(
    ("pointwise", np.int64),  # address of the compiled nonlinearity
    ("steps", np.int64),  # internal steps of a sampling time
    ("fine", TRANSFORM),  # of the dealiased grid
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
    # Offsets in w.
    ("next", np.int64),
    ("b", np.int64),
    ("c", np.int64),
    ("qf", np.int64),
    ("ff", np.int64),
)


@jit
def nonlinear(w: int, d: int, plan: Any, c: int, e: int, tape: int) -> int:
    """Address of the transform of g(u), u being the field of the spectrum x on the fine grid."""
    t = plan.fine
    rfft_unpack(w, plan.x, plan.z1, d, t, c, e)
    z = inverse(w, plan.z1, plan.z2, d, t, c, e)
    call_c(plan.pointwise, (w + 8 * z, t.m))
    call_c(plan.pointwise, (w + 8 * (z + d), t.m))
    return forward(w, z, plan.z1 + plan.z2 - z, d, t, c, e)


def internal_step(
    nonlinear: Callable[..., int], pack: Callable[..., Any] = rfft_pack
) -> Callable[..., None]:
    """One internal step of the spectrum x, compiled: integrate(w, d, plan, c, e, tape).

    nonlinear(w, d, plan, c, e, tape): the transform of g(u) of a stage; may keep plan.fine.m numbers
    of the stage at `tape`, of which the stages have consecutive ones. pack: eight modes of what it
    returns, as `rfft_pack`.
    """

    @jit
    def integrate(w: int, d: int, plan: Any, c: int, e: int, tape: int) -> None:
        # Read here, as the compiler cannot know that what is stored below is not the plan.
        m, factors, modes = plan.fine.m, plan.fine.split, plan.modes
        x, next_x, to_b, to_c = plan.x, plan.next, plan.b, plan.c
        e1, e2, qm, f2m = plan.e, plan.e2, plan.qm, plan.f2m
        f1m, f3m, qfs, ffs = plan.f1m, plan.f3m, plan.qf, plan.ff
        z = nonlinear(w, d, plan, c, e, tape)
        for k in range(0, modes, 8):
            g, v, qf = pack(w, z, d, m, factors, k, c, e), get(w, x + k, d), get(w, qfs + k, d)
            half, qg = plus_product(qf, c, e2 + k, e, v), product(c, qm + k, e, g)
            a = plus(half, qg)
            put(w, x + k, d, a)
            put(w, to_b + k, d, half)
            put(w, to_c + k, d, minus(plus_product(qf, c, e2 + k, e, a), qg))
            whole = plus_product(get(w, ffs + k, d), c, e1 + k, e, v)
            put(w, next_x + k, d, plus_product(whole, c, f1m + k, e, g))
        z = nonlinear(w, d, plan, c, e, tape + m)
        for k in range(0, modes, 8):
            g = pack(w, z, d, m, factors, k, c, e)
            put(w, x + k, d, plus_product(get(w, to_b + k, d), c, qm + k, e, g))
            put(w, next_x + k, d, plus_product(get(w, next_x + k, d), c, f2m + k, e, g))
        z = nonlinear(w, d, plan, c, e, tape + 2 * m)
        for k in range(0, modes, 8):
            g = pack(w, z, d, m, factors, k, c, e)
            qg = product(c, qm + k, e, g)
            put(w, x + k, d, plus(get(w, to_c + k, d), plus(qg, qg)))
            put(w, next_x + k, d, plus_product(get(w, next_x + k, d), c, f2m + k, e, g))
        z = nonlinear(w, d, plan, c, e, tape + 3 * m)
        for k in range(0, modes, 8):
            g = pack(w, z, d, m, factors, k, c, e)
            put(w, x + k, d, plus_product(get(w, next_x + k, d), c, f3m + k, e, g))

    return integrate


integrate = internal_step(nonlinear)


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


@jit_in_closure
def advance(state: int, action: int, w: int, d: int, plan: Any, c: int, e: int) -> None:
    """The state a sampling time later, in the scratch."""
    force(action, w, d, plan, c, e)
    analyse(state, w, d, plan, c, e)
    for _ in range(plan.steps):
        integrate(w, d, plan, c, e, 0)
    synthesise(w + 8 * plan.state, w, d, plan, c, e)


environments = environments_of(PLAN, advance, native, simd, fft, spectra)


def etdrk4_step(settings: StepSettings) -> ParallelStep:
    """The step z_{k+1} = f(z_k, a_k) of a semilinear equation, made ready.

    The nonlinearity is dealiased on a grid of at least 3/2 n_z points; exactly that where 3/2 n_z
    is 16 * 2^i * 3^j, else the next such number. ValueError where L grows beyond all bounds within
    an internal step; NotCompiledError, when it is loaded, for a nonlinearity that does not compile.
    """
    n_z, steps = settings.n_x, settings.steps
    fine = fine_length(n_z)
    c = etdrk4_coefficients(settings.linear_operator, settings.integration_time)
    # The compiled transform leaves out the factor 1/4m.
    m = settings.multiplier / (4 * fine)

    constants = Constants()
    plan = begin_plan(PLAN, settings, constants)
    plan["steps"] = steps
    plan["fine"] = constants.add_transform(fine, n_z // 2 + 1)
    spectra = constants.add_spectra
    plan["e"], plan["e2"], plan["q"] = spectra(c.e), spectra(c.e2), spectra(c.q)
    plan["qm"], plan["f1m"] = spectra(c.q * m), spectra(c.f1 * m)
    plan["f2m"], plan["f3m"] = spectra(2 * c.f2 * m), spectra(c.f3 * m)
    plan["f"] = spectra(c.f1 + 4 * c.f2 + c.f3)
    plan["supports"] = spectra(np.fft.rfft(settings.supports, axis=0).T / n_z)
    plane, modes = plane_size(max(fine, n_z // 2)), int(plan["modes"])
    size = lay_out(
        plan,
        {
            "z1": plane,
            "z2": plane,
            "x": fine + WIDTH,
            **dict.fromkeys(("next", "b", "c", "qf", "ff"), modes),
            "state": whole_lanes(n_z),
        },
    )
    return ParallelStep(
        environments,
        plan,
        constants,
        size,
        points_per_step=8 * steps * fine,
        called={"pointwise": partial(pointwise_loop, settings.nonlinearity)},
    )


def fine_length(n_z: int) -> int:
    """Complex length, half the points, of the dealiased grid."""
    length = -(-3 * n_z // 4)
    while not is_transform_length(length):
        length += 1
    return length
