# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The complex FFT of the kernel: Stockham's, over one transform, in lanes of eight.

A complex sequence of length m is two planes of float64 at an address `w`: real parts from offset
`x`, imaginary parts from `x + d`. Swapping the planes (`x + d`, `-d`) turns the forward transform
into the unscaled inverse one.

Lengths are m = 8 * 2^i * 3^j. The first pass has radix 8 and transposes its lanes, so that from
there on all strides are multiples of eight and every later pass runs on whole lanes. The first pass
works on whole lanes too: it may read 8 and write 56 elements beyond m, which the planes must have
room for (`plane_size`).

Source: Stockham autosort FFT, Van Loan, Computational Frameworks for the Fast Fourier Transform,
SIAM 1992, section 1.7.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.jit.cache import inlined_njit, jit
from pdeloop.jit.simd import (
    WIDTH,
    fma,
    load,
    minus_product,
    read,
    splat,
    store,
    transpose,
    whole_lanes,
)

SQRT_HALF = math.sqrt(0.5)
SIN_60 = math.sqrt(0.75)


def is_transform_length(m: int) -> bool:
    """True if `fft` can transform length m."""
    if m < 1 or m % WIDTH:
        return False
    rest = m // WIDTH
    for prime in (2, 3):
        while rest % prime == 0:
            rest //= prime
    return rest == 1


def plane_size(m: int) -> int:
    """Elements a plane needs for length m, a multiple of eight."""
    return WIDTH * whole_lanes(m // WIDTH) + WIDTH


def radices_of(m: int) -> list[int]:
    """Radices of the passes after the first."""
    radices, n = [], m // WIDTH
    while n > 1:
        radix = next(r for r in (8, 4, 3, 2) if n % r == 0 and (r, n) != (8, 16))
        radices.append(radix)
        n //= radix
    return radices


def twiddles_of(m: int) -> NDArray[np.complex128]:
    """Twiddle factors of all passes, in the order in which `fft` reads them."""
    b = m // WIDTH
    first = np.ones((WIDTH - 1, whole_lanes(b)), dtype=np.complex128)
    first[:, :b] = root(np.outer(np.arange(1, WIDTH), np.arange(b)), m)
    parts, n = [first], b
    for radix in radices_of(m):
        parts.append(root(np.outer(np.arange(n // radix), np.arange(1, radix)), n))
        n //= radix
    return np.concatenate([part.ravel() for part in parts])


def root(power: NDArray[np.int64], n: int) -> NDArray[np.complex128]:
    """exp(-2 pi i power / n), with the power reduced first so that no digit is lost."""
    factors: NDArray[np.complex128] = np.exp(-2j * np.pi * (power % n) / n)
    return factors


@jit
def times(ar: Any, ai: Any, br: Any, bi: Any) -> Any:
    """The complex product a b, in lanes."""
    return minus_product(ai, bi, ar * br), fma(ai, br, ar * bi)


@jit
def twiddled(w: int, y: int, d: int, p: int, ar: Any, ai: Any, c: int, v: int, e: int) -> None:
    """Store numbers times the twiddle factor v, which is 1 where p is 0."""
    if p:
        ar, ai = times(ar, ai, splat(read(c, v)), splat(read(c, v + e)))
    store(w, y, ar)
    store(w, y + d, ai)


@jit
def butterfly8(w: int, x: int, d: int, t: int) -> Any:
    """DFT of the eight numbers x, x + t, ..., x + 7t."""
    a0r, a0i = load(w, x), load(w, x + d)
    a1r, a1i = load(w, x + t), load(w, x + d + t)
    a2r, a2i = load(w, x + 2 * t), load(w, x + d + 2 * t)
    a3r, a3i = load(w, x + 3 * t), load(w, x + d + 3 * t)
    a4r, a4i = load(w, x + 4 * t), load(w, x + d + 4 * t)
    a5r, a5i = load(w, x + 5 * t), load(w, x + d + 5 * t)
    a6r, a6i = load(w, x + 6 * t), load(w, x + d + 6 * t)
    a7r, a7i = load(w, x + 7 * t), load(w, x + d + 7 * t)
    b0r, b0i, b4r, b4i = a0r + a4r, a0i + a4i, a0r - a4r, a0i - a4i
    b1r, b1i, b5r, b5i = a1r + a5r, a1i + a5i, a1r - a5r, a1i - a5i
    b2r, b2i, b6r, b6i = a2r + a6r, a2i + a6i, a2r - a6r, a2i - a6i
    b3r, b3i, b7r, b7i = a3r + a7r, a3i + a7i, a3r - a7r, a3i - a7i
    c0r, c0i, c2r, c2i = b0r + b2r, b0i + b2i, b0r - b2r, b0i - b2i
    c1r, c1i, c3r, c3i = b1r + b3r, b1i + b3i, b1r - b3r, b1i - b3i
    h = splat(SQRT_HALF)
    c5r, c5i = h * (b5r + b5i), h * (b5i - b5r)
    c7r, c7i = h * (b7i - b7r), h * (b7r + b7i)
    c4r, c4i, c6r, c6i = b4r + b6i, b4i - b6r, b4r - b6i, b4i + b6r
    d5r, d5i, d7r, d7i = c5r + c7r, c5i - c7i, c5r - c7r, c5i + c7i
    return (
        (c0r + c1r, c0i + c1i),
        (c4r + d5r, c4i + d5i),
        (c2r + c3i, c2i - c3r),
        (c6r + d7i, c6i - d7r),
        (c0r - c1r, c0i - c1i),
        (c4r - d5r, c4i - d5i),
        (c2r - c3i, c2i + c3r),
        (c6r - d7i, c6i + d7r),
    )


@jit
def first_pass(w: int, x: int, y: int, d: int, b: int, c: int, v: int, e: int) -> None:
    """Radix 8 at stride 1, eight butterflies at once, whose outputs a transpose makes neighbours."""
    s = whole_lanes(b)
    for p in range(0, b, 8):
        z = butterfly8(w, x + p, d, b)
        u = v + p
        r1, i1 = times(z[1][0], z[1][1], load(c, u), load(c, u + e))
        r2, i2 = times(z[2][0], z[2][1], load(c, u + s), load(c, u + s + e))
        r3, i3 = times(z[3][0], z[3][1], load(c, u + 2 * s), load(c, u + 2 * s + e))
        r4, i4 = times(z[4][0], z[4][1], load(c, u + 3 * s), load(c, u + 3 * s + e))
        r5, i5 = times(z[5][0], z[5][1], load(c, u + 4 * s), load(c, u + 4 * s + e))
        r6, i6 = times(z[6][0], z[6][1], load(c, u + 5 * s), load(c, u + 5 * s + e))
        r7, i7 = times(z[7][0], z[7][1], load(c, u + 6 * s), load(c, u + 6 * s + e))
        r = transpose((z[0][0], r1, r2, r3, r4, r5, r6, r7))
        i = transpose((z[0][1], i1, i2, i3, i4, i5, i6, i7))
        for row in range(8):
            store(w, y + 8 * p + 8 * row, r[row])
            store(w, y + 8 * p + 8 * row + d, i[row])


@jit
def butterfly4(w: int, x: int, d: int, t: int) -> Any:
    """DFT of the four numbers x, x + t, x + 2t, x + 3t."""
    a0r, a0i = load(w, x), load(w, x + d)
    a1r, a1i = load(w, x + t), load(w, x + t + d)
    a2r, a2i = load(w, x + 2 * t), load(w, x + 2 * t + d)
    a3r, a3i = load(w, x + 3 * t), load(w, x + 3 * t + d)
    b0r, b0i, b2r, b2i = a0r + a2r, a0i + a2i, a0r - a2r, a0i - a2i
    b1r, b1i, b3r, b3i = a1r + a3r, a1i + a3i, a1r - a3r, a1i - a3i
    return (
        (b0r + b1r, b0i + b1i),
        (b2r + b3i, b2i - b3r),
        (b0r - b1r, b0i - b1i),
        (b2r - b3i, b2i + b3r),
    )


@jit
def butterfly3(w: int, x: int, d: int, t: int) -> Any:
    """DFT of the three numbers x, x + t, x + 2t."""
    half, sine = splat(0.5), splat(SIN_60)
    a0r, a0i = load(w, x), load(w, x + d)
    a1r, a1i = load(w, x + t), load(w, x + t + d)
    a2r, a2i = load(w, x + 2 * t), load(w, x + 2 * t + d)
    b1r, b1i = a1r + a2r, a1i + a2i
    b2r, b2i = sine * (a1r - a2r), sine * (a1i - a2i)
    b0r, b0i = minus_product(half, b1r, a0r), minus_product(half, b1i, a0i)
    return (a0r + b1r, a0i + b1i), (b0r + b2i, b0i - b2r), (b0r - b2i, b0i + b2r)


@jit
def butterfly2(w: int, x: int, d: int, t: int) -> Any:
    """DFT of the two numbers x, x + t."""
    a0r, a0i = load(w, x), load(w, x + d)
    a1r, a1i = load(w, x + t), load(w, x + t + d)
    return (a0r + a1r, a0i + a1i), (a0r - a1r, a0i - a1i)


def later_pass(radix: int, butterfly: Callable[..., Any]) -> Callable[..., int]:
    """A pass of that radix: one_pass(w, x, y, d, m, s, c, v, e), from x to y; the next v."""

    @inlined_njit
    def one_pass(w: int, x: int, y: int, d: int, m: int, s: int, c: int, v: int, e: int) -> int:
        for p in range(m):
            for q in range(0, s, 8):
                z = butterfly(w, x + q + s * p, d, s * m)
                o = y + q + radix * s * p
                store(w, o, z[0][0])
                store(w, o + d, z[0][1])
                for j in range(1, radix):
                    twiddled(w, o + j * s, d, p, z[j][0], z[j][1], c, v + j - 1, e)
            v += radix - 1
        return v

    return one_pass


pass8, pass4 = later_pass(8, butterfly8), later_pass(4, butterfly4)
pass3, pass2 = later_pass(3, butterfly3), later_pass(2, butterfly2)


@inlined_njit
def one_pass(
    radix: int, w: int, x: int, y: int, d: int, m: int, s: int, c: int, v: int, e: int
) -> int:
    """A pass of this radix, see `later_pass`; radix 2 for any other."""
    if radix == 8:
        return pass8(w, x, y, d, m, s, c, v, e)
    if radix == 4:
        return pass4(w, x, y, d, m, s, c, v, e)
    if radix == 3:
        return pass3(w, x, y, d, m, s, c, v, e)
    return pass2(w, x, y, d, m, s, c, v, e)


@jit
def fft(w: int, x: int, y: int, d: int, t: Any, c: int, e: int) -> int:
    """Transform the t.m numbers at x, with y as scratch; returns where the result is, x or y.

    The twiddle factors stand at `c`, imaginary parts `e` further, from t.twiddles on.
    """
    b = t.m // 8
    v = t.twiddles
    first_pass(w, x, y, d, b, c, v, e)
    v += 7 * whole_lanes(b)
    m = b
    s = t.m // b  # 8, which as a constant would be a type of its own to compile for, without use
    passes = t.radices
    while passes:
        x, y = y, x
        radix = passes & 15
        passes >>= 4
        m //= radix
        # Where a loop is known to have one turn, the addresses of what it loads take a third of
        # the time. Most lengths have no pass between the first of these and the last.
        if m == 1:
            v = one_pass(radix, w, x, y, d, 1, s, c, v, e)
        elif s == 8:
            v = one_pass(radix, w, x, y, d, m, 8, c, v, e)
        else:
            v = one_pass(radix, w, x, y, d, m, s, c, v, e)
        s *= radix
    return y
