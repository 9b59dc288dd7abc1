# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A partial differential equation whose coefficients depend on the place, as a model.

    dz_c/dt (x) = sum_f C_fc(x) D^{j_f} M_f(z)(x) + (B a + c)(x),

for every component c of the field; M_f is a monomial of the components, and D^j a central difference
on a ring of grid points of distance 1: none for j = 0, the first and second one along the last axis
for j = 1, 2, along the axis before for j = 3, 4, and so on. Walls have coefficients of their own. Time
is in sampling times, each of equal Runge-Kutta steps of order 4. On one axis the factors of M_f may be
of neighbours, each at a distance of its own from x, as of chains of oscillators or species.

In a fit, as in `fit_spectral`, a sampling time is integrated with the current equation and bent to end
in the measured state; the change z_{k+1} - z_k is then linear in the coefficients, each with the mean
of its feature on the way. Coefficients are the sum of one that all points share and a part of each
point's own, which a ridge holds at zero where the data say nothing of it.

Of cells, not fields, the features are all monomials of a few neighbours to begin with
(`fit_neighbours`). As such plants are often chaotic, a small error of a step is a large one of a
rollout: after two passes, others regress what the model's own steps miss, on which the error of the
means has no effect, and monomials that explain nothing are left out, one by one.

References
----------
Brunton, Proctor, Kutz, "Discovering governing equations from data by sparse identification of
nonlinear dynamical systems", PNAS 113(15), 2016. Miller, "Subset Selection in Regression", 2nd ed.,
Chapman & Hall 2002, chapter 3 (backward elimination).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pdeloop.jit.cache import cached_njit, jit
from pdeloop.messages.arrays import Array, read_only
from pdeloop.messages.text import shown
from pdeloop.method.models.base import (
    COEFFICIENT_RIDGE,
    Arrays,
    StoredModel,
    checked_substeps,
    least_squares,
    orthonormal,
)
from pdeloop.method.reduce.reduced_model import Samples

POINT_SAMPLES = 800
"""Maximum number of data steps in a fit of finite differences."""
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


class Feature(NamedTuple):
    """A monomial: components of its factors, order of the derivative, points that factors are ahead."""

    factors: tuple[int, ...]
    order: int = 0
    shifts: tuple[int, ...] = ()


def features_of(components: int, axes: int = 1) -> tuple[Feature, ...]:
    """Monomials of a field's components up to degree 3.

    Linear ones have all differences, and squares those of first order, or all of a single component.
    """
    every = range(1 + 2 * axes)
    of_squares = [j for j in every if components == 1 or j % 2 or not j]
    orders = {1: list(every), 2: of_squares}
    monomials = [m for p in (1, 2, 3) for m in combinations_with_replacement(range(components), p)]
    return tuple(Feature(m, j) for m in monomials for j in orders.get(len(m), [0]))


def neighbour_features(components: int, reach: int = 2) -> tuple[Feature, ...]:
    """Monomials of a point and `reach` neighbours at each side, up to degree 2; cubic ones of one."""
    found = []
    for degree, most in {1: reach, 2: reach, 3: 1}.items():
        places = [(c, s) for s in range(-most, most + 1) for c in range(components)]
        for chosen in combinations_with_replacement(places, degree):
            found.append(Feature(tuple(c for c, _ in chosen), 0, tuple(s for _, s in chosen)))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class FiniteDifferenceModel(StoredModel):
    """The equation above, with C (F, components, n_x), B (n_z, n_a) and c (n_z,).

    table: F features; derivatives of one monomial stand together, beginning with that of order 0;
    substeps: Runge-Kutta steps of a sampling time; axes: grid points of each axis, the last one
    fastest, whose product is n_x.
    """

    FORM = "finite-difference"
    SHAPES: ClassVar = {
        "table": f"i:f {2 + 2 * MOST_FACTORS}",
        "coefficients": "f c p",
        "B": "n a",
        "constant": "n",
        "substeps": "i:",
        "axes": "i:d",
    }
    kind: str
    table: Table
    coefficients: Array
    B: Array
    constant: Array
    substeps: int
    axes: Table

    def step(self, states: Array, actions: Array) -> Array:
        z, a = read_only(states), read_only(actions)
        after = np.empty_like(z)
        advance(z, a, *self._known, after)
        return after

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        z, a, y = read_only(states), read_only(actions), read_only(covectors)
        on_states, on_actions = np.empty_like(z), np.empty_like(a)
        pull_back(z, a, y, *self._known, on_states, on_actions)
        return on_states, on_actions

    def means(self, states: Array, actions: Array, after: Array) -> tuple[Array, Array]:
        """The features' means (M, F, n_x) on the path bent to end in `after`, and how far it misses."""
        z, a, end = read_only(states), read_only(actions), read_only(after)
        found = np.empty((len(z), len(self.table), self.coefficients.shape[2]))
        miss = np.empty_like(z)
        mean_features(z, a, end, *self._known, found, miss)
        return found, miss

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Self:
        model = super().from_arrays(arrays)
        (_, components, n_x), axes = model.coefficients.shape, model.axes.tolist()
        counts, shifts = model.table[:, 0], model.table[:, 1 + MOST_FACTORS : -1]
        factors = model.table[:, 1 : 1 + MOST_FACTORS]
        ranges = (
            (counts - 1, MOST_FACTORS),
            (factors[np.arange(MOST_FACTORS) < counts[:, None]], components),
            (shifts, n_x),
            (model.table[:, -1], 1 + 2 * len(axes)),
        )
        if not all((numbers >= 0).all() and (numbers < end).all() for numbers, end in ranges):
            raise ValueError(f"a model of {n_x} points on {len(axes)} axes has unknown terms")
        if min(axes, default=0) < 1 or math.prod(axes) != n_x:
            raise ValueError(f"a model of {n_x} points has axes of {shown(axes)}")
        if components * n_x != model.n_z:
            raise ValueError(f"a model of {n_x} points has {model.n_z} numbers")
        checked_substeps(model.substeps)
        return model

    @cached_property
    def _known(self) -> tuple[Table, Table, Array, Array, Array, int]:
        arrays = read_only(self.coefficients), read_only(self.B), read_only(self.constant)
        return self.table, self.axes, *arrays, self.substeps


def of_features(
    kind: str,
    features: Sequence[Feature],
    C: Array,
    B: Array,
    constant: Array,
    substeps: int,
    shape: tuple[int, ...] = (),
) -> FiniteDifferenceModel:
    """The equation of these features; shape: points of each axis, where there are several."""
    n_x, rows = C.shape[2], []
    for factors, order, shifts in features:
        unused = MOST_FACTORS - len(factors)
        ahead = [shift % n_x for shift in shifts or (0,) * len(factors)]
        rows.append([len(factors), *factors, *(-1,) * unused, *ahead, *(0,) * unused, order])
    axes = np.array(shape or (n_x,), dtype=np.int64)
    table = np.array(rows, dtype=np.int64)
    return FiniteDifferenceModel(kind, table, C, B, constant, substeps, axes)


_POINT_PASSES = 4
"""How often an equation of finite differences is refitted along the paths of the last fit."""
_SETTLED = 0.1
"""Relative change of what its steps miss at which the passes end."""
_POINT_SUBSTEPS = 32
"""Maximum number of internal steps per sampling time."""
_COARSE_SAMPLES, _COARSE = 100, 1e-4
"""Data steps, at most, that choose internal ones, and what fewer may change in a step, per root mean
square of the change in all steps."""
_POINT_REACH = 2.5
"""Fastest rate of a finite-difference model times its internal step, of a rule of order 4."""


def fit_finite_difference(
    samples: Samples,
    *,
    kind: str,
    components: int = 1,
    ridge: float | None = None,
    shape: tuple[int, ...] = (),
) -> FiniteDifferenceModel | None:
    """The equation, or None where half of the samples overflow the first ones.

    ridge: of the points' own parts in normalised columns; None: they have none; shape: points of each
    axis, where there are several.
    """
    samples = samples.thinned(POINT_SAMPLES)
    features = features_of(components, len(shape) or 1)
    size = largest_of(samples)
    model, fitted = nothing(kind, features, samples, components, shape), None
    least = np.inf
    for _ in range(_POINT_PASSES):
        data = Regression.along(model, samples)
        if data is None or data.miss > (1.0 - _SETTLED) * least:
            break
        least = data.miss
        found = data.solved(coefficients(data.columns(), ridge), model)
        if found is None:
            break
        substeps = substeps_of(found, size, _POINT_REACH)
        model = fitted = replace(found, substeps=substeps)
    return fitted and coarsest(fitted, samples)


def nothing(
    kind: str,
    features: tuple[Feature, ...],
    samples: Samples,
    components: int,
    shape: tuple[int, ...] = (),
) -> FiniteDifferenceModel:
    """The equation of which nothing is known: a field stays as it is."""
    n_z, n_a = samples.before.shape[1], samples.actions.shape[1]
    C = np.zeros((len(features), components, n_z // components))
    return of_features(kind, features, C, np.zeros((n_z, n_a)), np.zeros(n_z), 8, shape)


def largest_of(samples: Samples) -> float:
    """The size of a field, for which internal steps are counted."""
    return float(np.quantile(np.abs(samples.before).max(axis=1), 0.9))


def coarsest(model: FiniteDifferenceModel, samples: Samples) -> FiniteDifferenceModel:
    """With the fewest internal steps that change no step by more than a share of the mean change."""
    samples = samples.thinned(_COARSE_SAMPLES)
    fine = model.step(samples.before, samples.actions)
    most = _COARSE * np.sqrt(np.mean(np.sum((samples.after - samples.before) ** 2, axis=1)))

    def suffice(substeps: int) -> bool:
        coarse = replace(model, substeps=substeps).step(samples.before, samples.actions)
        with np.errstate(invalid="ignore"):
            return bool(np.linalg.norm(coarse - fine, axis=1).max() <= most)

    counts = range(1, model.substeps)
    return replace(model, substeps=1 + bisect_left(counts, True, key=suffice))


def substeps_of(model: FiniteDifferenceModel, size: float, reach: float) -> int:
    """Enough internal steps for a field of that size, of `reach` over its fastest rate each."""
    # Of a second difference on a unit grid the largest rate is 4, of others 1.
    factors, orders = model.table[:, 0], model.table[:, -1]
    second = (orders > 0) & (orders % 2 == 0)
    growth = factors * size ** (factors - 1) * np.where(second, 4.0, 1.0)
    rate = float((np.abs(model.coefficients) * growth[:, None, None]).sum(axis=0).max())
    return int(np.clip(np.ceil(rate / reach), 2, _POINT_SUBSTEPS))


@dataclass(frozen=True, eq=False)
class Columns:
    """The normal equations of each point, free of the inputs, in columns X of the norm 1.

    gram (n_x, F, F), moment (n_x, F, components): X^T X, X^T y; square: sum y^2; scale (F,): of
    columns.
    """

    gram: Array
    moment: Array
    square: float
    scale: Array

    def unexplained(self, C: Array) -> float:
        """The share of the sum of y^2 that coefficients (n_x, F, components) do not explain."""
        if not self.square > 0.0:
            return 0.0
        c = C * self.scale[:, None]
        rest = self.square - float(np.sum(c * (2.0 * self.moment - self.gram @ c)))
        return max(rest, 0.0) / self.square


@dataclass(frozen=True, eq=False)
class Regression:
    """What a pass regresses: y (n_x, N, components), the change, on the features' means X (n_x, N, F).

    common (N, n_a + 1): the inputs and 1; miss: root mean square of what the model's steps missed.
    """

    X: Array
    y: Array
    common: Array
    miss: float

    @classmethod
    def along(
        cls, model: FiniteDifferenceModel, samples: Samples, *, missed: bool = False
    ) -> Regression | None:
        """That of the model's paths, or None where half of the samples overflow it.

        missed: explain what the model's own steps miss, apart from what it explains already. Where it
        is best, an error of the means then has no effect on it.
        """
        components, n_x = model.coefficients.shape[1:]
        root = samples.weights()
        means, miss = model.means(samples.before, samples.actions, samples.after)
        ok = np.isfinite(means).all(axis=(1, 2)) & np.isfinite(miss).all(axis=1)
        if 2 * ok.sum() < len(samples):
            return None
        means, miss, actions, root = means[ok], miss[ok], samples.actions[ok], root[ok]
        if missed:
            own = np.einsum("nfx,fcx->ncx", means, model.coefficients).reshape(miss.shape)
            change = (miss + own + actions @ model.B.T + model.constant) * root[:, None]
        else:
            change = (samples.after - samples.before)[ok] * root[:, None]
        return cls(
            (means * root[:, None, None]).transpose(2, 0, 1),
            change.reshape(-1, components, n_x).transpose(2, 0, 1),
            np.hstack([actions, np.ones((len(actions), 1))]) * root[:, None],
            float(np.sqrt(np.mean((miss * root[:, None]) ** 2))),
        )

    def columns(self) -> Columns:
        """The normal equations without the inputs."""
        basis = orthonormal(self.common)
        X, y = (values - basis @ (basis.T @ values) for values in (self.X, self.y))
        scale = np.sqrt(np.sum(X**2, axis=(0, 1)))
        scale = np.where(scale > 0.0, scale, 1.0)
        X = X / scale
        transposed = X.transpose(0, 2, 1)
        return Columns(transposed @ X, transposed @ y, float(np.sum(y**2)), scale)

    def solved(self, C: Array, model: FiniteDifferenceModel) -> FiniteDifferenceModel | None:
        """The equation with coefficients (n_x, F, components); None where it is not finite."""
        n_x, _, components = self.y.shape
        left = (self.y - self.X @ C).transpose(1, 0, 2).reshape(len(self.common), -1)
        inputs = least_squares(self.common, left)
        if not (np.isfinite(C).all() and np.isfinite(inputs).all()):
            return None
        inputs = inputs.reshape(-1, n_x, components).transpose(2, 1, 0).reshape(model.n_z, -1)
        return replace(
            model,
            coefficients=np.ascontiguousarray(C.transpose(1, 2, 0)),
            B=np.ascontiguousarray(inputs[:, :-1]),
            constant=np.ascontiguousarray(inputs[:, -1]),
        )


def coefficients(columns: Columns, ridge: float | None) -> Array:
    """Coefficients of every point, (n_x, F, components)."""
    gram, moment, scale = columns.gram, columns.moment, columns.scale
    eye = np.eye(len(scale))
    shared = np.linalg.solve(gram.sum(axis=0) + COEFFICIENT_RIDGE * eye, moment.sum(axis=0))
    found = np.broadcast_to(shared, moment.shape)
    if ridge is not None:
        own = np.linalg.solve(gram + ridge / len(gram) * eye, moment - gram @ shared)
        found = found + own
    every: Array = found / scale[:, None]
    return every


_NEAR_SAMPLES = 400
"""Maximum number of data steps in a fit of products."""
_NEAR_REACH = 0.5
"""Fastest rate of such a model times its internal step."""
_NEAR_SCREENED = 0.1
"""Share of the change that may be unexplained along straight paths between samples."""
_NEAR_HOPELESS = 0.05
"""Share of the change that may be unexplained along the paths of the first fit."""
_NEAR_SUBSTEPS = 8
"""Maximum number of internal steps of the paths of a fit."""
_NEAR_PASSES = 8
"""Further passes of a model of neighbours, on what its steps miss."""
_NEAR_DROPPED = 0.5
"""Share by which its residual may grow when products are left out."""
_NEAR_NEGLIGIBLE = 1e-12
"""Squared error that counts as none, as a share of the squared change."""


def fit_neighbours(
    samples: Samples, *, kind: str, components: int = 1, ridge: float | None = None
) -> FiniteDifferenceModel | None:
    """The equation, or None where the plant is of another kind.

    Of several components second neighbours, with half as many terms again, are tried where the first
    ones do not describe the plant. ridge: as for `fit_finite_difference`.
    """
    samples = samples.thinned(_NEAR_SAMPLES)
    for reach in (1, 2) if components > 1 else (2,):
        features = neighbour_features(components, reach)
        empty = replace(nothing(kind, features, samples, components), substeps=1)
        found = fitted(empty, samples, ridge)
        if found is not None:
            return found
    return None


def fitted(
    model: FiniteDifferenceModel, samples: Samples, ridge: float | None
) -> FiniteDifferenceModel | None:
    """The equation of the terms of an empty one, which has substeps of its own then, or None."""
    size = largest_of(samples)
    for most in (_NEAR_SCREENED, _NEAR_HOPELESS):
        data = Regression.along(model, samples)
        if data is None:
            return None
        columns = data.columns()
        C = coefficients(columns, ridge)
        found = data.solved(C, model)
        if found is None or not columns.unexplained(C) <= most**2:
            return None  # the plant is of another kind
        # Means that are roughly right are enough for what follows.
        substeps = substeps_of(found, size, _NEAR_REACH)
        model = replace(found, substeps=min(substeps, _NEAR_SUBSTEPS))
    every = _passes(model, samples, ridge)
    if every is None:
        return None
    missed = Regression.along(every, samples, missed=True)
    if missed is None:
        return every
    kept = explaining(missed.columns(), ridge is None)
    fewer = replace(
        every,
        table=every.table[kept],
        coefficients=np.ascontiguousarray(every.coefficients[kept]),
    )
    return _passes(fewer, samples, ridge) or every


def _passes(
    model: FiniteDifferenceModel, samples: Samples, ridge: float | None
) -> FiniteDifferenceModel | None:
    """The best equation of passes that regress what steps miss."""
    size = largest_of(samples)
    best, least = None, np.inf
    for _ in range(_NEAR_PASSES + 1):
        data = Regression.along(model, samples, missed=True)
        if data is None or not data.miss < least:
            break
        settled = data.miss > (1.0 - _SETTLED) * least
        best, least = model, data.miss
        if settled:
            break
        found = data.solved(coefficients(data.columns(), ridge), model)
        if found is None:
            break
        substeps = substeps_of(found, size, _NEAR_REACH)
        model = replace(found, substeps=substeps)
    return best


def explaining(columns: Columns, shared: bool) -> list[int]:
    """The features without which the residual is clearly larger, left out one by one."""
    gram, moment = columns.gram, columns.moment
    if shared:
        gram, moment = gram.sum(axis=0)[None], moment.sum(axis=0)[None]
    size = COEFFICIENT_RIDGE * np.trace(gram, axis1=1, axis2=2)[:, None, None]
    inverse = np.linalg.inv(gram + size * np.eye(gram.shape[1]))
    w = inverse @ moment
    residual = max(columns.square - float(np.sum(moment * w)), 0.0)
    most = _NEAR_DROPPED * residual + _NEAR_NEGLIGIBLE * columns.square
    kept = list(range(gram.shape[1]))
    lost = 0.0
    while len(kept) > 1:
        diagonal = np.diagonal(inverse, axis1=1, axis2=2)
        own = np.sum(np.sum(w**2, axis=2) / diagonal, axis=0)
        f = int(np.argmin(own))
        if lost + own[f] > most:
            break
        lost += float(own[f])
        ratio = inverse[:, :, f] / diagonal[:, f, None]
        w = np.delete(w - ratio[:, :, None] * w[:, f, None, :], f, axis=1)
        inverse = inverse - ratio[:, :, None] * inverse[:, f, None, :]
        inverse = np.delete(np.delete(inverse, f, axis=1), f, axis=2)
        del kept[f]
    return kept
