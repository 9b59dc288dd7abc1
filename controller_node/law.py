# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The projected control law, compiled.

An environment's action does not depend on how many environments are in the batch, nor on its place
in it, to the last bit: every sum runs over its terms one after the other (no BLAS, no
reassociation). Sums that do not depend on each other are computed side by side: those of eight
modes or actuators in the lanes of a vector, and those of four environments, which hide each other's
latency.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.jit import cache, simd
from pdeloop.jit.cache import cached_njit, jit
from pdeloop.jit.simd import (
    fma,
    load,
    load_unaligned,
    read,
    read_word,
    splat,
    store,
    whole_lanes,
    write,
)
from pdeloop.messages.arrays import read_only

LAW = np.dtype(
    [
        ("n_z", np.int64),
        ("n_s", np.int64),
        ("n_a", np.int64),
        # Addresses of arrays; the last axis of the first three is filled up to whole lanes.
        ("bases", np.int64),  # U, models by n_z by n_s
        ("constant", np.int64),  # K_b s_r, M by n_a
        ("feedback", np.int64),  # K_a^T, M by n_s by n_a
        ("index", np.int64),  # model of every environment, M
        ("low", np.int64),  # bounds of an action, n_a
        ("high", np.int64),
        ("scratch", np.int64),  # four times n_s and once n_a, each up to whole lanes
    ]
)


def padded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """A copy whose last axis is filled up to whole lanes."""
    *others, last = values.shape
    copy = np.zeros((*others, whole_lanes(last)))  # np.pad takes ten times as long
    copy[..., :last] = values
    return copy


@jit
def basis_of(law: Any, m: int) -> int:
    """Address of the basis of an environment."""
    size = law.n_z * whole_lanes(law.n_s)
    address: int = law.bases + 8 * size * read_word(law.index, m)
    return address


@jit
def reduce(law: Any, states: int, first: int, batch: int) -> None:
    """s = U^T z of four environments, into the scratch; of the last one again beyond the batch."""
    n_z, width, s = law.n_z, whole_lanes(law.n_s), law.scratch
    last = batch - 1
    m0, m1 = first, min(first + 1, last)
    m2, m3 = min(first + 2, last), min(first + 3, last)
    z0, z1 = states + 8 * n_z * m0, states + 8 * n_z * m1
    z2, z3 = states + 8 * n_z * m2, states + 8 * n_z * m3
    u0, u1, u2, u3 = basis_of(law, m0), basis_of(law, m1), basis_of(law, m2), basis_of(law, m3)
    for block in range(0, width, 8):
        a0, a1, a2, a3 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        k = block
        for i in range(n_z):
            a0 = fma(load(u0, k), splat(load_unaligned(z0, i)), a0)
            a1 = fma(load(u1, k), splat(load_unaligned(z1, i)), a1)
            a2 = fma(load(u2, k), splat(load_unaligned(z2, i)), a2)
            a3 = fma(load(u3, k), splat(load_unaligned(z3, i)), a3)
            k += width
        store(s, block, a0)
        store(s, width + block, a1)
        store(s, 2 * width + block, a2)
        store(s, 3 * width + block, a3)


@jit
def answer(law: Any, m: int, s: int, action: int) -> None:
    """The action of an environment whose reduced state is at the address s."""
    n_s, n_a = law.n_s, law.n_a
    width, wide = whole_lanes(n_s), whole_lanes(n_a)
    sums = law.scratch + 8 * 4 * width
    for block in range(0, wide, 8):
        a = load(law.constant, m * wide + block)
        for j in range(n_s):
            a = fma(load(law.feedback, (m * n_s + j) * wide + block), splat(read(s, j)), a)
        store(sums, block, a)
    for k in range(n_a):
        value, low, high = read(sums, k), read(law.low, k), read(law.high, k)
        if value > high:
            value = high
        elif value < low:
            value = low
        write(action, k, value)


@jit
def act(law: Any, states: int, actions: int, batch: int) -> None:
    """a = K_a s + K_b s_r of every environment, with s = U^T z."""
    width = whole_lanes(law.n_s)
    for first in range(0, batch, 4):
        reduce(law, states, first, batch)
        for m in range(first, min(first + 4, batch)):
            answer(law, m, law.scratch + 8 * width * (m - first), actions + 8 * law.n_a * m)


@cached_njit(cache, simd)
def control(
    laws: NDArray[np.void], states: NDArray[np.float64], actions: NDArray[np.float64]
) -> None:
    """Write the actions (M, n_a) that answer the states (M, n_z)."""
    act(laws[0], states.ctypes.data, actions.ctypes.data, len(states))


def load_compiled() -> None:
    """Load the law, or compile it."""
    nothing = np.zeros((0, 1))
    control(np.zeros(1, LAW), read_only(nothing), nothing)
