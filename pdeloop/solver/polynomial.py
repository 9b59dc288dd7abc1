# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The compiled step of an equation with polynomial nonlinear parts, given as numbers, and its adjoint.

It is the step of `kernel` and the adjoint of `adjoint`, with

    N(v) = sum_q m_q F[g_q(u)] + sum_l n_l F[h_l(x, u)] + F_a,
           g_q(u) = sum_{p = 2}^P C_qp u^p,        h_l(x, u) = sum_{p = 1}^P c_lp(x) u^p

in place of m F[g(u)] + F_a: each g_q and h_l has a multiplier of its own, and neither they nor the
polynomials are compiled, so that one machine code serves all such equations. u can be cut to +-clip
before.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.jit import cache, simd
from pdeloop.jit.cache import cached_njit, jit
from pdeloop.jit.simd import clamp, fma, lane_sum, read, splat, where_equal, write
from pdeloop.messages.arrays import Array
from pdeloop.solver import adjoint, fft, kernel, spectra
from pdeloop.solver.adjoint import conjugate_product, internal_pull_back
from pdeloop.solver.kernel import force, internal_step
from pdeloop.solver.spectra import (
    TRANSFORM,
    analyse,
    forward,
    get,
    inverse,
    plus,
    plus_product,
    put,
    rfft_pack,
    rfft_unpack,
    synthesise,
)

PLAN = np.dtype(
    [
        ("parts", np.int64),  # Q
        ("degree", np.int64),  # P
        ("varying", np.int64),  # number of h_l
        ("clip", np.float64),
        ("steps", np.int64),  # internal steps of a sampling time
        ("n_x", np.int64),  # grid points
        ("n_a", np.int64),  # supports, with that of the constant forcing
        ("modes", np.int64),  # n_x//2 + 1, up to whole lanes
        ("coarse", TRANSFORM),  # of the published grid; none where its length has no transform
        ("fine", TRANSFORM),  # of the dealiased grid
        *(
            (name, np.int64)
            for name in (
                # Addresses of constants and scratch, and the distances of their planes.
                "constants",
                "constants_apart",
                "scratch",
                "scratch_apart",
                # Offsets in c. Spectra of the step, as in `kernel`; m_q; C_qp and p C_qp; n_l; c_lp at
                # the even points of the dealiased grid, and at the odd ones in the other plane.
                "e",
                "e2",
                "q",
                "qm",
                "f1m",
                "f2m",
                "f3m",
                "f",
                "supports",
                "multipliers",
                "polynomials",
                "slopes",
                "factors",
                "coefficients",
                "analysis",  # unused, like the next
                "synthesis",
                # Of the integrals of powers along a path.
                "weight_begin",
                "weight_middle",
                "weight_end",
                # Offsets in w.
                "x",
                "z1",
                "z2",
                "next",
                "b",
                "c",
                "qf",
                "ff",
                "part",
                "sum",
                "tape",
                "covector",
                "on_b",
                "on_c",
                "on_force",
                "path",
                "power",
                "now",
                "total",
            )
        ),
    ]
)


@jit
def field_to(tape: int, w: int, x: int, d: int, plan: Any, c: int, e: int) -> None:
    """The field of the spectrum x on the dealiased grid."""
    t = plan.fine
    rfft_unpack(w, x, plan.z1, d, t, c, e)
    z = inverse(w, plan.z1, plan.z2, d, t, c, e)
    for j in range(0, t.m, 8):
        put(w, tape + j, d, get(w, z + j, d))


@jit
def horner(coefficients: int, terms: int, c: int, u: Any) -> Any:
    """The polynomial c_1 u + c_2 u^2 + .. + c_terms u^terms of lanes."""
    total = splat(read(c, coefficients + terms - 1)) * u
    for p in range(terms - 2, -1, -1):
        total = (total + splat(read(c, coefficients + p))) * u
    return total


@jit
def horner_at(plan: Any, part: int, j: int, c: int, e: int, u: Any, slope: int) -> Any:
    """Lanes of h_l(x, u)/u = c_l1 + c_l2 u + ..; with slope = 1 of dh_l/du = c_l1 + 2 c_l2 u + .."""
    real, imaginary, terms = splat(0.0), splat(0.0), plan.degree
    for p in range(terms - 1, -1, -1):
        own = get(c, plan.coefficients + (part * terms + p) * plan.fine.m + j, e)
        factor = splat(1.0 + slope * p)
        real, imaginary = real * u[0] + factor * own[0], imaginary * u[1] + factor * own[1]
    return real, imaginary


@jit
def nonlinear(w: int, d: int, plan: Any, c: int, e: int, tape: int) -> int:
    """Address of N but for F_a, u being the field of the spectrum x, kept at `tape`."""
    t, clip, modes, terms = plan.fine, splat(plan.clip), plan.modes, plan.degree - 1
    field_to(tape, w, plan.x, d, plan, c, e)
    for k in range(0, modes, 8):
        put(w, plan.sum + k, d, (splat(0.0), splat(0.0)))
    for part in range(plan.parts):
        own, multiplier = plan.polynomials + part * terms, plan.multipliers + part * modes
        for j in range(0, t.m, 8):
            u = get(w, tape + j, d)
            ur, ui = clamp(u[0], clip), clamp(u[1], clip)
            put(w, plan.z1 + j, d, (ur * horner(own, terms, c, ur), ui * horner(own, terms, c, ui)))
        z = forward(w, plan.z1, plan.z2, d, t, c, e)
        for k in range(0, modes, 8):
            g = rfft_pack(w, z, d, t.m, t.split, k, c, e)
            put(w, plan.sum + k, d, plus_product(get(w, plan.sum + k, d), c, multiplier + k, e, g))
    for part in range(plan.varying):
        multiplier = plan.factors + part * modes
        for j in range(0, t.m, 8):
            u = get(w, tape + j, d)
            u = clamp(u[0], clip), clamp(u[1], clip)
            total = horner_at(plan, part, j, c, e, u, 0)
            put(w, plan.z1 + j, d, (u[0] * total[0], u[1] * total[1]))
        z = forward(w, plan.z1, plan.z2, d, t, c, e)
        for k in range(0, modes, 8):
            g = rfft_pack(w, z, d, t.m, t.split, k, c, e)
            put(w, plan.sum + k, d, plus_product(get(w, plan.sum + k, d), c, multiplier + k, e, g))
    at: int = plan.sum
    return at


@jit
def modes_at(w: int, x: int, d: int, m: int, factors: int, k: int, c: int, e: int) -> Any:
    """Eight modes of a spectrum, in the place of `rfft_pack`."""
    return get(w, x + k, d)


integrate = internal_step(nonlinear, modes_at)


@jit
def transposed(w: int, d: int, plan: Any, c: int, e: int, tape: int) -> int:
    """Address of the transform of all slopes of g_q and h_l times the fields of m_q* x and n_l* x."""
    t, clip, modes, terms = plan.fine, splat(plan.clip), plan.modes, plan.degree - 1
    last = plan.parts + plan.varying - 1
    # The products are gathered in what the next field leaves free: z1, z2 and a third plane.
    for part in range(plan.parts + plan.varying):
        own, further = plan.slopes + part * terms, part - plan.parts
        multiplier = plan.multipliers + part * modes
        if further >= 0:
            multiplier = plan.factors + further * modes
        for k in range(0, modes, 8):
            value = conjugate_product(c, multiplier + k, e, get(w, plan.x + k, d))
            put(w, plan.part + k, d, value)
        rfft_unpack(w, plan.part, plan.z1, d, t, c, e)
        z = inverse(w, plan.z1, plan.z2, d, t, c, e)
        for j in range(0, t.m, 8):
            u, y = get(w, tape + j, d), get(w, z + j, d)
            ur, ui = clamp(u[0], clip), clamp(u[1], clip)
            if further >= 0:
                slope = horner_at(plan, further, j, c, e, (ur, ui), 1)
            else:
                slope = horner(own, terms, c, ur), horner(own, terms, c, ui)
            total = where_equal(ur, u[0], slope[0]) * y[0], where_equal(ui, u[1], slope[1]) * y[1]
            if part:
                total = plus(get(w, plan.power + j, d), total)
            if part == last:
                put(w, plan.z1 + j, d, total)
            else:
                put(w, plan.power + j, d, total)
    if last < 0:
        for j in range(0, t.m, 8):
            put(w, plan.z1 + j, d, (splat(0.0), splat(0.0)))
    return forward(w, plan.z1, plan.z2, d, t, c, e)


pull_back_internal = internal_pull_back(transposed)


@jit
def begin(spectrum: Any, action: int, w: int, d: int, plan: Any, c: int, e: int) -> None:
    """The forcing, and x of a spectrum (2, modes)."""
    force(action, w, d, plan, c, e)
    to_scratch(spectrum, plan.x, w, d, plan)


@jit
def to_scratch(spectrum: Any, x: int, w: int, d: int, plan: Any) -> None:
    """A spectrum (2, modes) into the scratch, with zeros up to whole lanes."""
    modes = spectrum.shape[1]
    for k in range(modes):
        write(w, x + k, spectrum[0, k])
        write(w, x + k + d, spectrum[1, k])
    for k in range(modes, plan.modes):
        write(w, x + k, 0.0)
        write(w, x + k + d, 0.0)


@jit
def from_scratch(spectrum: Any, x: int, w: int, d: int) -> None:
    """A spectrum of the scratch into an array (2, modes)."""
    for k in range(spectrum.shape[1]):
        spectrum[0, k] = read(w, x + k)
        spectrum[1, k] = read(w, x + k + d)


@jit
def by_action(j: int, w: int, d: int, plan: Any, c: int, e: int) -> float:
    """The derivative by action j, of that by the forcing in the scratch."""
    at, total = plan.supports + j * plan.modes, splat(0.0)
    for k in range(0, plan.modes, 8):
        on, own = get(w, plan.on_force + k, d), get(c, at + k, e)
        total = fma(on[0], own[0], fma(on[1], own[1], total))
    first = read(w, plan.on_force) * read(c, at)  # the only mode of weight 1, and real
    found: float = plan.n_x * (2.0 * lane_sum(total) - first)
    return found


SOURCES = (cache, simd, fft, spectra, kernel, adjoint)


@cached_njit(*SOURCES)
def analysed(states: Array, found: Array, plans: NDArray[np.void]) -> None:
    """Write the spectra (M, 2, modes) of states, in the scaling of `spectra`."""
    plan = plans[0]
    w, d, c, e = plan.scratch, plan.scratch_apart, plan.constants, plan.constants_apart
    for i in range(len(states)):
        analyse(states.ctypes.data + 8 * plan.n_x * i, w, d, plan, c, e)
        from_scratch(found[i], plan.x, w, d)


@cached_njit(*SOURCES)
def synthesised(spectra: Array, found: Array, plans: NDArray[np.void]) -> None:
    """Write the states of spectra (M, 2, modes)."""
    plan = plans[0]
    w, d, c, e = plan.scratch, plan.scratch_apart, plan.constants, plan.constants_apart
    for i in range(len(spectra)):
        to_scratch(spectra[i], plan.x, w, d, plan)
        synthesise(found.ctypes.data + 8 * plan.n_x * i, w, d, plan, c, e)


@cached_njit(*SOURCES)
def advance(spectra: Array, actions: Array, plans: NDArray[np.void]) -> None:
    """Advance spectra (M, 2, modes) by a sampling time, in place; M/P in a row by each of P plans."""
    each = len(spectra) // len(plans)
    for p in range(len(plans)):
        plan = plans[p]
        w, d, c, e = plan.scratch, plan.scratch_apart, plan.constants, plan.constants_apart
        for i in range(p * each, (p + 1) * each):
            begin(spectra[i], actions.ctypes.data + 8 * plan.n_a * i, w, d, plan, c, e)
            for _ in range(plan.steps):
                integrate(w, d, plan, c, e, plan.tape)
            from_scratch(spectra[i], plan.x, w, d)


@cached_njit(*SOURCES)
def pull_back(
    spectra: Array, actions: Array, covectors: Array, on_actions: Array, plans: NDArray[np.void]
) -> None:
    """Turn covectors (M, 2, modes) of spectra a sampling time later into those before, in place."""
    plan = plans[0]
    w, d, c, e = plan.scratch, plan.scratch_apart, plan.constants, plan.constants_apart
    block = 4 * plan.fine.m
    for i in range(len(spectra)):
        begin(spectra[i], actions.ctypes.data + 8 * plan.n_a * i, w, d, plan, c, e)
        for n in range(plan.steps):
            integrate(w, d, plan, c, e, plan.tape + n * block)
        to_scratch(covectors[i], plan.covector, w, d, plan)
        for k in range(0, plan.modes, 8):
            put(w, plan.on_force + k, d, (splat(0.0), splat(0.0)))
        for n in range(plan.steps - 1, -1, -1):
            pull_back_internal(w, d, plan, c, e, plan.tape + n * block)
        from_scratch(covectors[i], plan.covector, w, d)
        for j in range(plan.n_a):
            on_actions[i, j] = by_action(j, w, d, plan, c, e)
