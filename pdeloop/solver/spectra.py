# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Compiled transforms between a state, its spectrum and a field on the dealiased grid.

Spectra are those of u(x) = sum_j X_j exp(2 pi i j x / L), j = -n_x/2..n_x/2: the real FFT over the
number of points. A real sequence of length 2m is transformed as the m complex numbers
u_2j + i u_2j+1. Their transform Z follows from the spectrum X (`rfft_unpack`), and X from Z
(`rfft_pack`). With T_k = -i exp(-pi i k / m),

      Z_k = (X_k + X*_{m-k}) + T*_k (X_k - X*_{m-k})
    4mX_k = (Z_k + Z*_{m-k}) + T_k  (Z_k - Z*_{m-k}).

Complex numbers are in two planes, see `fft`; `w` and `d` are the scratch and the distance of its
planes, `c` and `e` those of the constants, and `plan` says what stands where.
"""

from typing import Any

import numpy as np

from pdeloop.jit.cache import jit
from pdeloop.jit.simd import backwards, fma, load, minus_product, read, splat, store, write
from pdeloop.solver.fft import fft, times

Complex = Any
"""A pair (real, imaginary) of lanes."""

TRANSFORM = np.dtype(
    [
        ("m", np.int64),  # complex length; 0 where the transform is a product with a matrix
        ("radices", np.int64),  # of the passes after the first, four bits each
        ("twiddles", np.int64),  # offset in c
        ("split", np.int64),  # offset in c of T_k
    ]
)


@jit
def get(w: int, x: int, d: int) -> Complex:
    """Eight complex numbers from x on."""
    return load(w, x), load(w, x + d)


@jit
def put(w: int, x: int, d: int, value: Complex) -> None:
    """Store eight complex numbers from x on."""
    store(w, x, value[0])
    store(w, x + d, value[1])


@jit
def plus(a: Complex, b: Complex) -> Complex:
    """a + b."""
    return a[0] + b[0], a[1] + b[1]


@jit
def minus(a: Complex, b: Complex) -> Complex:
    """a - b."""
    return a[0] - b[0], a[1] - b[1]


@jit
def product(c: int, at: int, e: int, value: Complex) -> Complex:
    """Constants times a value."""
    return times(load(c, at), load(c, at + e), value[0], value[1])


@jit
def plus_product(total: Complex, c: int, at: int, e: int, value: Complex) -> Complex:
    """A number and constants times a value."""
    ar, ai, (br, bi) = load(c, at), load(c, at + e), value
    return minus_product(ai, bi, fma(ar, br, total[0])), fma(ai, br, fma(ar, bi, total[1]))


@jit
def with_mirror(w: int, x: int, d: int, m: int, k: int) -> tuple[Complex, Complex]:
    """Eight numbers x_k + x*_{m-k} and x_k - x*_{m-k}, from k on."""
    # A load of just these would cross what was stored as a whole, and wait for the cache.
    a, below, above = get(w, x + k, d), get(w, x + m - k - 8, d), get(w, x + m - k, d)
    br, bi = backwards(below[0], above[0]), backwards(below[1], above[1])
    return (a[0] + br, a[1] - bi), (a[0] - br, a[1] + bi)


@jit
def rfft_unpack(w: int, x: int, z: int, d: int, t: Any, c: int, e: int) -> None:
    """Z from X, see above: the input of the complex inverse transform."""
    m, factors = t.m, t.split
    for k in range(0, m, 8):
        (s, r), v = with_mirror(w, x, d, m, k), get(c, factors + k, e)
        put(
            w,
            z + k,
            d,
            (
                fma(r[1], v[1], fma(r[0], v[0], s[0])),
                minus_product(r[0], v[1], fma(r[1], v[0], s[1])),
            ),
        )


@jit
def rfft_pack(w: int, z: int, d: int, m: int, factors: int, k: int, c: int, e: int) -> Complex:
    """Eight modes of the spectrum, from k on, times 4m."""
    s, r = with_mirror(w, z, d, m, k)
    return plus_product(s, c, factors + k, e, r)


@jit
def forward(w: int, z: int, other: int, d: int, t: Any, c: int, e: int) -> int:
    """Transform the numbers at z; returns where the result is, its first numbers repeated behind."""
    z = fft(w, z, other, d, t, c, e)
    put(w, z + t.m, d, get(w, z, d))
    return z


@jit
def inverse(w: int, z: int, other: int, d: int, t: Any, c: int, e: int) -> int:
    """The inverse transform of the numbers at z, without its factor; returns where the result is."""
    return fft(w, z + d, other + d, -d, t, c, e) - d


@jit
def analyse(state: int, w: int, d: int, plan: Any, c: int, e: int) -> None:
    """The spectrum x of a state."""
    t = plan.coarse
    if t.m:
        for j in range(t.m):
            write(w, plan.z1 + j, read(state, 2 * j))
            write(w, plan.z1 + j + d, read(state, 2 * j + 1))
        z = forward(w, plan.z1, plan.z2, d, t, c, e)
        scale = splat(0.25 / t.m)
        for k in range(0, plan.modes, 8):
            g = rfft_pack(w, z, d, t.m, t.split, k, c, e)
            put(w, plan.x + k, d, (scale * g[0], scale * g[1]))
    else:
        for k in range(0, plan.modes, 8):
            x = splat(0.0), splat(0.0)
            for j in range(plan.n_x):
                u = splat(read(state, j))
                row = get(c, plan.analysis + j * plan.modes + k, e)
                x = fma(u, row[0], x[0]), fma(u, row[1], x[1])
            put(w, plan.x + k, d, x)
    # Lanes beyond the last mode hold whatever was beside the transform.
    for k in range(plan.n_x // 2 + 1, plan.modes):
        write(w, plan.x + k, 0.0)
        write(w, plan.x + k + d, 0.0)


@jit
def synthesise(state: int, w: int, d: int, plan: Any, c: int, e: int) -> None:
    """The state of the spectrum x, which as for any inverse real FFT has real first and last modes."""
    t, last = plan.coarse, plan.n_x // 2
    write(w, plan.x + d, 0.0)
    write(w, plan.x + d + last, 0.0)
    if t.m:
        rfft_unpack(w, plan.x, plan.z1, d, t, c, e)
        z = inverse(w, plan.z1, plan.z2, d, t, c, e)
        for j in range(t.m):
            write(state, 2 * j, read(w, z + j))
            write(state, 2 * j + 1, read(w, z + j + d))
    else:
        for j in range(plan.n_x):
            u = 0.0
            for k in range(last + 1):
                at = plan.synthesis + j * plan.modes + k
                u += read(w, plan.x + k) * read(c, at) - read(w, plan.x + k + d) * read(c, at + e)
            write(state, j, u)
