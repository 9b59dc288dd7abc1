# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A partial differential equation whose coefficients depend on the place, as a model.

    dz_c/dt (x) = sum_f C_fc(x) D^{j_f} M_f(z)(x) + (B a + c)(x),

for every component c of the field; M_f is a monomial of the components, and D^j, j = 0, 1, 2, a central
difference on a ring of grid points of distance 1. Anything else (walls) has coefficients of its own
where that shows. Time is in sampling times, each of equal Runge-Kutta steps of order 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.array_files import checked_array
from loop_interfaces.arrays import Array
from loop_interfaces.jit.cache import cached_njit, jit
from loop_interfaces.text import shown
from loop_method.models.base import Arrays, linearised, numbers_of, steps_of, text_of

Feature = tuple[tuple[int, ...], int]
"""A monomial, as its components, and the order of its derivative."""
MOST_FACTORS = 5


def features_of(components: int, degree: int = 3) -> tuple[Feature, ...]:
    """Monomials of a field's components up to degree 3; pure powers up to `degree`."""
    orders = {1: 3, 2: 3 if components == 1 else 2}
    monomials = [m for p in (1, 2, 3) for m in combinations_with_replacement(range(components), p)]
    monomials += [(c,) * p for c in range(components) for p in range(4, degree + 1)]
    return tuple((m, j) for m in monomials for j in range(orders.get(len(m), 1)))


Table = NDArray[np.int64]
"""A feature a row, as `FiniteDifferenceModel.table` has them."""


@dataclass(frozen=True, eq=False)
class FiniteDifferenceModel:
    """The equation above.

    Attributes
    ----------
    kind : str
    features : sequence of (components of a monomial, order of its derivative)
        F of them; those of one monomial are neighbours.
    coefficients : (F, components, n_x) array
        C.
    B : (n_z, n_a) array
    constant : (n_z,) array
        c.
    substeps : int
        Runge-Kutta steps of a sampling time.
    """

    kind: str
    features: tuple[Feature, ...]
    coefficients: Array
    B: Array
    constant: Array
    substeps: int

    @property
    def n_z(self) -> int:
        return len(self.constant)

    @property
    def n_a(self) -> int:
        return int(self.B.shape[1])

    @cached_property
    def table(self) -> Table:
        """Rows: number of factors, the factors, and the order, of each feature."""
        rows = [[len(m), *m, *(-1,) * (MOST_FACTORS - len(m)), order] for m, order in self.features]
        return np.array(rows, dtype=np.int64)

    def step(self, states: Array, actions: Array) -> Array:
        z, a = _contiguous(states), _contiguous(actions)
        after = np.empty_like(z)
        advance(z, a, self.table, *self._arrays(), self.substeps, after)
        return after

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        z, a, y = _contiguous(states), _contiguous(actions), _contiguous(covectors)
        on_states, on_actions = np.empty_like(z), np.empty_like(a)
        pull_back(z, a, y, self.table, *self._arrays(), self.substeps, on_states, on_actions)
        return on_states, on_actions

    def means(self, states: Array, actions: Array, after: Array) -> tuple[Array, Array]:
        """The features' means over a sampling time, and by how much the step misses `after`.

        They are those of the path bent linearly in time to end there.

        Returns
        -------
        (M, F, n_x), (M, n_z)
        """
        z, a, end = _contiguous(states), _contiguous(actions), _contiguous(after)
        found = np.empty((len(z), len(self.features), self.coefficients.shape[2]))
        miss = np.empty_like(z)
        mean_features(z, a, end, self.table, *self._arrays(), self.substeps, found, miss)
        return found, miss

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        return linearised(self, state, action)

    def arrays(self) -> Arrays:
        return {
            "form": np.array("finite-difference"),
            "kind": np.array(self.kind),
            "table": self.table,
            "coefficients": self.coefficients,
            "B": self.B,
            "constant": self.constant,
            "substeps": np.array(self.substeps),
        }

    @staticmethod
    def from_arrays(arrays: Arrays) -> FiniteDifferenceModel:
        """The model of `arrays`."""
        table = checked_array(arrays, "table", "i", (None, MOST_FACTORS + 2))
        coefficients = numbers_of(arrays, "coefficients", len(table), None, None)
        _, components, n_x = coefficients.shape
        features = tuple((tuple(row[1 : 1 + row[0]]), row[-1]) for row in table.tolist())
        if known := set(features) - set(features_of(components, MOST_FACTORS)):
            raise ValueError(f"a model has unknown terms: {shown(sorted(known))}")
        return FiniteDifferenceModel(
            text_of(arrays, "kind"),
            features,
            coefficients,
            numbers_of(arrays, "B", components * n_x, None),
            numbers_of(arrays, "constant", components * n_x),
            steps_of(arrays),
        )

    def _arrays(self) -> tuple[Array, Array, Array]:
        return self.coefficients, self.B, self.constant


def _contiguous(values: Array) -> Array:
    return np.ascontiguousarray(values, dtype=np.float64)


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
def monomial(z: Array, row: Array, ring: Array) -> None:
    """A monomial at the points 1 .. n_x of a ring, whose ends are repeated."""
    n_x = z.shape[1]
    for i in range(n_x):
        ring[1 + i] = z[row[1], i]
    for factor in range(1, row[0]):
        c = row[1 + factor]
        for i in range(n_x):
            ring[1 + i] *= z[c, i]
    ring[0], ring[n_x + 1] = ring[n_x], ring[1]


@jit
def difference(ring: Array, order: int, out: Array) -> None:
    """D^order at all points."""
    n_x = out.size
    if order == 0:
        for i in range(n_x):
            out[i] = ring[1 + i]
    elif order == 1:
        for i in range(n_x):
            out[i] = 0.5 * (ring[2 + i] - ring[i])
    else:
        for i in range(n_x):
            out[i] = ring[2 + i] - 2.0 * ring[1 + i] + ring[i]


@jit
def rate(
    z: Array, table: Table, C: Array, force: Array, ring: Array, value: Array, out: Array
) -> None:
    """dz/dt, components by points."""
    components, n_x = z.shape
    for c in range(components):
        for i in range(n_x):
            out[c, i] = force[c, i]
    for f in range(len(table)):
        if table[f, -1] == 0:  # the first of its monomial
            monomial(z, table[f], ring)
        difference(ring, table[f, -1], value)
        for c in range(components):
            for i in range(n_x):
                out[c, i] += C[f, c, i] * value[i]


@jit
def transposed_rate(
    z: Array, y: Array, table: Table, C: Array, ring: Array, value: Array, on_m: Array, out: Array
) -> None:
    """(d rate/dz)^T y."""
    components, n_x = z.shape
    out[:] = 0.0
    on_m[:] = 0.0
    for f in range(len(table)):
        for i in range(n_x):
            total = 0.0
            for c in range(components):
                total += C[f, c, i] * y[c, i]
            ring[1 + i] = total
        ring[0], ring[n_x + 1] = ring[n_x], ring[1]
        order = table[f, -1]
        difference(ring, order, value)
        sign = -1.0 if order == 1 else 1.0  # the transpose of a central difference
        for i in range(n_x):
            on_m[i] += sign * value[i]
        if f + 1 < len(table) and table[f + 1, -1] != 0:
            continue
        for own in range(table[f, 0]):
            for i in range(n_x):
                value[i] = on_m[i]
            for factor in range(table[f, 0]):
                if factor != own:
                    c = table[f, 1 + factor]
                    for i in range(n_x):
                        value[i] *= z[c, i]
            c = table[f, 1 + own]
            for i in range(n_x):
                out[c, i] += value[i]
        on_m[:] = 0.0


@jit
def runge_kutta(
    z: Array, table: Table, C: Array, force: Array, h: float, stages: Array, k: Array, ring: Array,
    value: Array,
) -> None:  # fmt: skip
    """An internal step in place; stages (4, ..): where the rates k (4, ..) were taken."""
    components, n_x = z.shape
    for stage in range(4):
        reach = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
        before = k[max(stage - 1, 0)]
        for c in range(components):
            for i in range(n_x):
                stages[stage, c, i] = z[c, i] + reach * before[c, i] if stage else z[c, i]
        rate(stages[stage], table, C, force, ring, value, k[stage])
    for c in range(components):
        for i in range(n_x):
            z[c, i] += h / 6.0 * (k[0, c, i] + 2.0 * k[1, c, i] + 2.0 * k[2, c, i] + k[3, c, i])


@cached_njit()
def advance(
    states: Array, actions: Array, table: Table, C: Array, B: Array, constant: Array, substeps: int,
    after: Array,
) -> None:  # fmt: skip
    """Write the states a sampling time later."""
    components, n_x = C.shape[1], C.shape[2]
    shape = (components, n_x)
    force, ring, value = np.empty(shape), np.empty(n_x + 2), np.empty(n_x)
    stages, k = np.empty((4, components, n_x)), np.empty((4, components, n_x))
    for m in range(len(states)):
        z = after[m].reshape(shape)
        z[:] = states[m].reshape(shape)
        forcing(actions[m], B, constant, force)
        for _ in range(substeps):
            runge_kutta(z, table, C, force, 1.0 / substeps, stages, k, ring, value)


@cached_njit()
def pull_back(
    states: Array, actions: Array, covectors: Array, table: Table, C: Array, B: Array,
    constant: Array, substeps: int, on_states: Array, on_actions: Array,
) -> None:  # fmt: skip
    """Write the transposed products."""
    components, n_x = C.shape[1], C.shape[2]
    shape, h = (components, n_x), 1.0 / substeps
    force, ring, value = np.empty(shape), np.empty(n_x + 2), np.empty(n_x)
    tape, k = np.empty((substeps, 4, components, n_x)), np.empty((4, components, n_x))
    z, on_m, on_force = np.empty(shape), np.empty(n_x), np.empty(shape)
    own, y, g = np.empty(shape), np.empty(shape), np.empty(shape)
    total = np.empty(shape)
    for m in range(len(states)):
        z[:] = states[m].reshape(shape)
        forcing(actions[m], B, constant, force)
        for n in range(substeps):
            runge_kutta(z, table, C, force, h, tape[n], k, ring, value)
        own[:] = covectors[m].reshape(shape)
        on_force[:] = 0.0
        for n in range(substeps - 1, -1, -1):
            g[:] = 0.0
            total[:] = own
            for stage in range(3, -1, -1):
                weight = h / 6.0 if stage in (0, 3) else h / 3.0
                reach = 0.0 if stage == 3 else (h if stage == 2 else 0.5 * h)
                for c in range(components):
                    for i in range(n_x):
                        y[c, i] = weight * own[c, i] + reach * g[c, i]
                        on_force[c, i] += y[c, i]
                transposed_rate(tape[n, stage], y, table, C, ring, value, on_m, g)
                for c in range(components):
                    for i in range(n_x):
                        total[c, i] += g[c, i]
            own[:] = total
        on_states[m] = own.reshape(own.size)
        flat = on_force.reshape(on_force.size)
        for j in range(B.shape[1]):
            on_actions[m, j] = 0.0
        for i in range(flat.size):
            for j in range(B.shape[1]):
                on_actions[m, j] += B[i, j] * flat[i]


@cached_njit()
def mean_features(
    states: Array, actions: Array, after: Array, table: Table, C: Array, B: Array, constant: Array,
    substeps: int, found: Array, miss: Array,
) -> None:  # fmt: skip
    """Write the features' means by the trapezoidal rule, and the misses."""
    components, n_x = C.shape[1], C.shape[2]
    shape = (components, n_x)
    force, ring, value = np.empty(shape), np.empty(n_x + 2), np.empty(n_x)
    stages, k = np.empty((4, components, n_x)), np.empty((4, components, n_x))
    path, bent = np.empty((substeps + 1, components, n_x)), np.empty(shape)
    z = np.empty(shape)
    for m in range(len(states)):
        z[:] = states[m].reshape(shape)
        path[0] = z
        forcing(actions[m], B, constant, force)
        for n in range(substeps):
            runge_kutta(z, table, C, force, 1.0 / substeps, stages, k, ring, value)
            path[n + 1] = z
        end = after[m].reshape(shape)
        miss[m] = (end - z).reshape(z.size)
        found[m] = 0.0
        for n in range(substeps + 1):
            weight = (0.5 if n in (0, substeps) else 1.0) / substeps
            share = n / substeps
            for c in range(components):
                for i in range(n_x):
                    bent[c, i] = path[n, c, i] + share * (end[c, i] - z[c, i])
            for f in range(len(table)):
                if table[f, -1] == 0:
                    monomial(bent, table[f], ring)
                difference(ring, table[f, -1], value)
                for i in range(n_x):
                    found[m, f, i] += weight * value[i]
