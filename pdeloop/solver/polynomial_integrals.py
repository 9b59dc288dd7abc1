# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Compiled integrals of powers of a field along a path of the step of `polynomial`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.jit.cache import cached_njit, jit
from pdeloop.jit.simd import clamp, fma, splat
from pdeloop.messages.arrays import Array
from pdeloop.solver import polynomial
from pdeloop.solver.polynomial import SOURCES, begin, field_to, from_scratch, integrate, to_scratch
from pdeloop.solver.spectra import forward, get, minus, plus_product, product, put, rfft_pack


@jit
def record_path(w: int, d: int, plan: Any, c: int, e: int) -> None:
    """The spectrum x at the internal steps of a sampling time, itself first, from plan.path on."""
    modes = plan.modes
    for n in range(plan.steps + 1):
        if n:
            integrate(w, d, plan, c, e, plan.tape)
        for k in range(0, modes, 8):
            put(w, plan.path + n * modes + k, d, get(w, plan.x + k, d))


@jit
def powers(w: int, d: int, plan: Any, c: int, e: int) -> None:
    """The spectra of u^p, p = 1 .. P, from plan.now on, u being the field of the spectrum x."""
    modes, t = plan.modes, plan.fine
    clip, scale = splat(plan.clip), splat(0.25 / t.m)
    for k in range(0, modes, 8):
        put(w, plan.now + k, d, get(w, plan.x + k, d))
    field_to(plan.tape, w, plan.x, d, plan, c, e)
    for j in range(0, t.m, 8):
        u = get(w, plan.tape + j, d)
        u = clamp(u[0], clip), clamp(u[1], clip)
        put(w, plan.tape + j, d, u)
        put(w, plan.power + j, d, u)
    for p in range(1, plan.degree):
        for j in range(0, t.m, 8):
            u, power = get(w, plan.tape + j, d), get(w, plan.power + j, d)
            power = power[0] * u[0], power[1] * u[1]
            put(w, plan.power + j, d, power)
            put(w, plan.z1 + j, d, power)
        z = forward(w, plan.z1, plan.z2, d, t, c, e)
        for k in range(0, modes, 8):
            own = rfft_pack(w, z, d, t.m, t.split, k, c, e)
            put(w, plan.now + p * modes + k, d, (scale * own[0], scale * own[1]))


@jit
def accumulate(weight: int, w: int, d: int, plan: Any, c: int, e: int) -> None:
    """Add weights, spectra at an offset in c, times the powers to the integrals."""
    modes = plan.modes
    for p in range(plan.degree):
        for k in range(0, modes, 8):
            at = p * modes + k
            total, now = get(w, plan.total + at, d), get(w, plan.now + at, d)
            put(w, plan.total + at, d, plus_product(total, c, weight + k, e, now))


@jit
def propagate(w: int, d: int, plan: Any, c: int, e: int) -> None:
    """The integrals so far, as they contribute two internal steps later."""
    modes = plan.modes
    for p in range(plan.degree):
        for k in range(0, modes, 8):
            at = plan.total + p * modes + k
            half = product(c, plan.e + k, e, get(w, at, d))
            put(w, at, d, product(c, plan.e + k, e, half))


@cached_njit(*SOURCES, polynomial)
def integrals(
    spectra: Array, actions: Array, ends: Array, found: Array, plans: NDArray[np.void]
) -> None:
    """Write the integrals of powers over a sampling time, on paths bent to `ends`, (P, M, 2, modes).

    By Simpson's rule, exponentially weighted, over an even number of internal steps. Turns `ends` into
    what the paths miss them by.
    """
    plan = plans[0]
    w, d, c, e = plan.scratch, plan.scratch_apart, plan.constants, plan.constants_apart
    modes, steps = plan.modes, plan.steps
    for i in range(len(spectra)):
        begin(spectra[i], actions.ctypes.data + 8 * plan.n_a * i, w, d, plan, c, e)
        record_path(w, d, plan, c, e)
        to_scratch(ends[i], plan.covector, w, d, plan)
        for k in range(0, modes, 8):  # by how much the end is missed
            end, reached = get(w, plan.covector + k, d), get(w, plan.x + k, d)
            put(w, plan.covector + k, d, minus(end, reached))
        for at in range(0, plan.degree * modes, 8):
            put(w, plan.total + at, d, (splat(0.0), splat(0.0)))
        for n in range(steps + 1):
            share, path = splat(n / steps), plan.path + n * modes
            for k in range(0, modes, 8):
                x, miss = get(w, path + k, d), get(w, plan.covector + k, d)
                put(w, plan.x + k, d, (fma(share, miss[0], x[0]), fma(share, miss[1], x[1])))
            powers(w, d, plan, c, e)
            if n % 2:
                accumulate(plan.weight_middle, w, d, plan, c, e)
            else:
                if n:
                    accumulate(plan.weight_end, w, d, plan, c, e)
                if n < steps:
                    propagate(w, d, plan, c, e)
                    accumulate(plan.weight_begin, w, d, plan, c, e)
        from_scratch(ends[i], plan.covector, w, d)
        for p in range(plan.degree):
            from_scratch(found[p, i], plan.total + p * modes, w, d)
