# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The compiled steps of a `FiniteDifferenceModel`, their transposes, and the means of its features."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdeloop.jit.cache import cached_njit, jit
from pdeloop.messages.arrays import Array

MOST_FACTORS = 3
Table = NDArray[np.int64]
"""A feature a row: its number of factors, the factors, their shifts, and the order of its difference.

A shift is 0 .. n_x - 1, counted on the ring.
"""


@jit
def copy(source: Array, target: Array) -> None:
    """Element by element: Numba compiles the text of an error for `target[:] = source`, a second."""
    for i in range(target.size):
        target[i] = source[i]


@jit
def forcing(action: Array, B: Array, constant: Array, force: Array) -> None:
    """B a + c, as components by points."""
    flat = force.reshape(force.size)
    for i in range(flat.size):
        total = constant[i]
        for j in range(action.size):
            total += B[i, j] * action[j]
        flat[i] = total


@jit
def multiply(z: Array, table: Table, f: int, without: int, value: Array) -> None:
    """Multiply by all factors of a monomial but one, if that is among them."""
    n_x = z.shape[1]
    for factor in range(table[f, 0]):
        if factor == without:
            continue
        c, ahead = table[f, 1 + factor], table[f, 1 + MOST_FACTORS + factor]
        if ahead == 0:
            for i in range(n_x):
                value[i] *= z[c, i]
            continue
        # Slices: a computed index might be negative, and such loops are not vectorised.
        front, back, end = z[c, ahead:], z[c, :ahead], value[n_x - ahead :]
        for i in range(front.size):
            value[i] *= front[i]
        for i in range(back.size):
            end[i] *= back[i]


@jit
def monomial(z: Array, table: Table, f: int, value: Array) -> None:
    """A monomial at all points."""
    for i in range(value.size):
        value[i] = 1.0
    multiply(z, table, f, -1, value)


@jit
def difference(values: Array, order: int, shape: Table, out: Array) -> None:
    """D^order at all points, order > 0, along an axis that is a ring."""
    axis = len(shape) - 1 - (order - 1) // 2
    stride = 1
    for other in range(axis + 1, len(shape)):
        stride *= shape[other]
    block = shape[axis] * stride
    inner = block - 2 * stride
    for begin in range(0, out.size, block):
        z, target = values[begin : begin + block], out[begin : begin + block]
        for edge in (0, block - stride):
            for i in range(edge, edge + stride):
                before, after = z[(i - stride) % block], z[(i + stride) % block]
                target[i] = after - 2.0 * z[i] + before
                if order % 2 == 1:
                    target[i] = 0.5 * (after - before)
        # Slices, as in `multiply`.
        behind, own, ahead, there = z, z[stride:], z[2 * stride :], target[stride:]
        if order % 2 == 1:
            for i in range(inner):
                there[i] = 0.5 * (ahead[i] - behind[i])
        else:
            for i in range(inner):
                there[i] = ahead[i] - 2.0 * own[i] + behind[i]


@jit
def rate(
    z: Array, table: Table, shape: Table, C: Array, force: Array, value: Array, moved: Array,
    out: Array,
) -> None:  # fmt: skip
    """dz/dt, components by points."""
    components, n_x = z.shape
    for c in range(components):
        for i in range(n_x):
            out[c, i] = force[c, i]
    for f in range(len(table)):
        if table[f, -1] == 0:  # the first of its monomial
            monomial(z, table, f, value)
            for c in range(components):
                for i in range(n_x):
                    out[c, i] += C[f, c, i] * value[i]
            continue
        difference(value, table[f, -1], shape, moved)
        for c in range(components):
            for i in range(n_x):
                out[c, i] += C[f, c, i] * moved[i]


@jit
def transposed_rate(
    z: Array, y: Array, table: Table, shape: Table, C: Array, value: Array, moved: Array,
    on_m: Array, out: Array,
) -> None:  # fmt: skip
    """(d rate/dz)^T y."""
    components, n_x = z.shape
    out[:] = 0.0
    on_m[:] = 0.0
    for f in range(len(table)):
        for i in range(n_x):
            value[i] = 0.0
        for c in range(components):
            for i in range(n_x):
                value[i] += C[f, c, i] * y[c, i]
        order = table[f, -1]
        if order == 0:
            for i in range(n_x):
                on_m[i] += value[i]
        else:
            difference(value, order, shape, moved)
            sign = -1.0 if order % 2 == 1 else 1.0  # the transpose of a central difference
            for i in range(n_x):
                on_m[i] += sign * moved[i]
        if f + 1 < len(table) and table[f + 1, -1] != 0:
            continue
        for own in range(table[f, 0]):
            c, ahead = table[f, 1 + own], table[f, 1 + MOST_FACTORS + own]
            for i in range(n_x):
                value[i] = on_m[i]
            multiply(z, table, f, own, value)
            if ahead == 0:
                for i in range(n_x):
                    out[c, i] += value[i]
                continue
            front, back, end = out[c, ahead:], out[c, :ahead], value[n_x - ahead :]
            for i in range(front.size):
                front[i] += value[i]
            for i in range(back.size):
                back[i] += end[i]
        on_m[:] = 0.0


@jit
def runge_kutta(
    z: Array, table: Table, shape: Table, C: Array, force: Array, h: float, stages: Array, k: Array,
    value: Array, moved: Array,
) -> None:  # fmt: skip
    """An internal step in place; stages (4, ..): where the rates k (4, ..) were taken."""
    components, n_x = z.shape
    for stage in range(4):
        reach = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
        before = k[max(stage - 1, 0)]
        for c in range(components):
            for i in range(n_x):
                stages[stage, c, i] = z[c, i] + reach * before[c, i] if stage else z[c, i]
        rate(stages[stage], table, shape, C, force, value, moved, k[stage])
    for c in range(components):
        for i in range(n_x):
            z[c, i] += h / 6.0 * (k[0, c, i] + 2.0 * k[1, c, i] + 2.0 * k[2, c, i] + k[3, c, i])


@cached_njit()
def advance(
    states: Array, actions: Array, table: Table, axes: Table, C: Array, B: Array, constant: Array,
    substeps: int, after: Array,
) -> None:  # fmt: skip
    """Write the states a sampling time later."""
    components, n_x = C.shape[1], C.shape[2]
    shape = (components, n_x)
    force, value, moved = np.empty(shape), np.empty(n_x), np.empty(n_x)
    stages, k = np.empty((4, components, n_x)), np.empty((4, components, n_x))
    for m in range(len(states)):
        copy(states[m], after[m])
        z = after[m].reshape(shape)
        forcing(actions[m], B, constant, force)
        for _ in range(substeps):
            runge_kutta(z, table, axes, C, force, 1.0 / substeps, stages, k, value, moved)


@cached_njit()
def pull_back(
    states: Array, actions: Array, covectors: Array, table: Table, axes: Table, C: Array, B: Array,
    constant: Array, substeps: int, on_states: Array, on_actions: Array,
) -> None:  # fmt: skip
    """Write the transposed products."""
    components, n_x = C.shape[1], C.shape[2]
    shape, h = (components, n_x), 1.0 / substeps
    force, value, moved = np.empty(shape), np.empty(n_x), np.empty(n_x)
    tape, k = np.empty((substeps, 4, components, n_x)), np.empty((4, components, n_x))
    z, on_m, on_force = np.empty(shape), np.empty(n_x), np.empty(shape)
    own, y, g = np.empty(shape), np.empty(shape), np.empty(shape)
    total, flat, flat_own = np.empty(shape), z.reshape(z.size), own.reshape(own.size)
    for m in range(len(states)):
        copy(states[m], flat)
        forcing(actions[m], B, constant, force)
        for n in range(substeps):
            runge_kutta(z, table, axes, C, force, h, tape[n], k, value, moved)
        copy(covectors[m], flat_own)
        on_force[:] = 0.0
        for n in range(substeps - 1, -1, -1):
            g[:] = 0.0
            copy(flat_own, total.reshape(total.size))
            for stage in range(3, -1, -1):
                weight = h / 6.0 if stage in (0, 3) else h / 3.0
                reach = 0.0 if stage == 3 else (h if stage == 2 else 0.5 * h)
                for c in range(components):
                    for i in range(n_x):
                        y[c, i] = weight * own[c, i] + reach * g[c, i]
                        on_force[c, i] += y[c, i]
                transposed_rate(tape[n, stage], y, table, axes, C, value, moved, on_m, g)
                for c in range(components):
                    for i in range(n_x):
                        total[c, i] += g[c, i]
            copy(total.reshape(total.size), flat_own)
        copy(flat_own, on_states[m])
        forces = on_force.reshape(on_force.size)
        for j in range(B.shape[1]):
            on_actions[m, j] = 0.0
        for i in range(forces.size):
            for j in range(B.shape[1]):
                on_actions[m, j] += B[i, j] * forces[i]


@cached_njit()
def mean_features(
    states: Array, actions: Array, after: Array, table: Table, axes: Table, C: Array, B: Array,
    constant: Array, substeps: int, found: Array, miss: Array,
) -> None:  # fmt: skip
    """Write the features' means by the trapezoidal rule, and the misses."""
    components, n_x = C.shape[1], C.shape[2]
    shape = (components, n_x)
    force, value, moved = np.empty(shape), np.empty(n_x), np.empty(n_x)
    stages, k = np.empty((4, components, n_x)), np.empty((4, components, n_x))
    path, bent = np.empty((substeps + 1, components, n_x)), np.empty(shape)
    z = np.empty(shape)
    flat = z.reshape(z.size)
    for m in range(len(states)):
        copy(states[m], flat)
        copy(flat, path[0].reshape(z.size))
        forcing(actions[m], B, constant, force)
        for n in range(substeps):
            runge_kutta(z, table, axes, C, force, 1.0 / substeps, stages, k, value, moved)
            copy(flat, path[n + 1].reshape(z.size))
        end = after[m].reshape(shape)
        for i in range(z.size):
            miss[m, i] = after[m, i] - flat[i]
        found[m] = 0.0
        for n in range(substeps + 1):
            weight, share = (0.5 if n in (0, substeps) else 1.0) / substeps, n / substeps
            for c in range(components):
                for i in range(n_x):
                    bent[c, i] = path[n, c, i] + share * (end[c, i] - z[c, i])
            for f in range(len(table)):
                if table[f, -1] == 0:
                    monomial(bent, table, f, value)
                    for i in range(n_x):
                        found[m, f, i] += weight * value[i]
                    continue
                difference(value, table[f, -1], axes, moved)
                for i in range(n_x):
                    found[m, f, i] += weight * moved[i]
