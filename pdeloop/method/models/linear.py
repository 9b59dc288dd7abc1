# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear models, for plants that are not equations on a grid, models of fewer numbers, and their fits.

A model of some directions or points of a state is one of the whole state,

    z_{k+1} = P f(S z_k, a_k).

Of a large state S and P are POD modes, and f is linear. Fields on several axes may be modelled on a
coarser grid: S takes the values at some of the grid points, and P, the least-squares interpolation of
measured states, gives the whole field. Fields that a law can influence are smooth.

Of few sensors' readings y it is, with innovations e_k,

    x_{k+1} = A x_k + B a_k + G e_k,        U^T y_k = C x_k + e_k

(`pdeloop.method.reduce.subspace`). The likeliest x_0 of a measured rollout gives the e_k with which the
model reproduces the readings. Under another law it uses the same ones: the noise, the dynamics beyond
the order and, as an approximation, the nonlinearity.

References
----------
Ljung, "System Identification: Theory for the User", 2nd ed., section 4.3 (innovations form).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pdeloop.jit.cache import cached_njit
from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array, read_only
from pdeloop.method.models.base import (
    COEFFICIENT_RIDGE,
    FORMS,
    Arrays,
    FieldModel,
    StoredModel,
    model_of,
)
from pdeloop.method.models.finite_difference import (
    POINT_SAMPLES,
    FiniteDifferenceModel,
    fit_finite_difference,
)
from pdeloop.method.reduce.reduced_model import Samples, Trajectory, turns
from pdeloop.method.reduce.subspace import InnovationModel, driven, subspace_model


@dataclass(frozen=True, eq=False)
class LinearModel(StoredModel):
    """z_{k+1} = A z_k + B a_k + c, with the constant c."""

    FORM = "linear"
    SHAPES: ClassVar = {"constant": "n", "A": "n n", "B": "n a"}
    kind: str
    A: Array
    B: Array
    constant: Array

    def step(self, states: Array, actions: Array) -> Array:
        after = np.tile(self.constant, (len(states), 1))
        add_products(read_only(states), read_only(self.A.T), after)
        add_products(read_only(actions), read_only(self.B.T), after)
        return after

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        on_states, on_actions = np.zeros(states.shape), np.zeros(actions.shape)
        y = read_only(covectors)
        add_products(y, read_only(self.A), on_states)
        add_products(y, read_only(self.B), on_actions)
        return on_states, on_actions

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        return self.A.copy(), self.B.copy()


@cached_njit()
def add_products(rows: Array, matrix: Array, totals: Array) -> None:
    """totals += rows @ matrix, one row after the other: BLAS rounds by how many there are."""
    for m in range(len(rows)):
        for i in range(rows.shape[1]):
            value = rows[m, i]
            for j in range(matrix.shape[1]):
                totals[m, j] += value * matrix[i, j]


def fit_linear(samples: Samples, *, kind: str, ridge: float) -> LinearModel | None:
    """Least squares on the change of the state, about the means; ridge: of normalised columns."""
    n_z, change = samples.before.shape[1], samples.after - samples.before
    columns = np.hstack([samples.before, samples.actions])
    mean, moved = columns.mean(axis=0), change.mean(axis=0)  # an offset is nothing to hold at zero
    columns = columns - mean
    scale = np.sqrt(np.mean(columns**2, axis=0))
    scale[:n_z] = np.sqrt(np.mean(scale[:n_z] ** 2))
    scale = np.where(scale > 0.0, scale, 1.0)
    columns = columns / scale
    gram = columns.T @ columns / len(columns) + ridge * np.eye(len(scale))
    moment = columns.T @ (change - moved) / len(columns)
    found = np.linalg.solve(gram, moment) / scale[:, None]
    if not np.isfinite(found).all():
        return None
    A, B, constant = np.eye(n_z) + found[:n_z].T, found[n_z:].T, moved - mean @ found
    return LinearModel(kind, *(np.ascontiguousarray(x) for x in (A, B, constant)))


_LOW_RANK_RIDGE = 1e-12
"""Ridge of low-rank models."""
_SNAPSHOTS = 400
"""Maximum number of states that POD modes are computed from."""
_ENERGY = 1e-12
"""Share of the energy below which a POD mode is left out."""
_SAMPLES_PER_MODE = 4
"""Data steps per unknown in a row of a low-rank model."""
_COARSE_POINTS = 256
"""Maximum number of grid points of a model on several axes; on finer grids every n-th point is used."""
_INNER = "inner."


@dataclass(frozen=True, eq=False)
class ProjectedModel:
    """The model above: the inner one f, the restriction S (m, n_z), the prolongation P (n_z, m)."""

    FORM = "projected"
    inner: FieldModel
    restriction: Array
    prolongation: Array

    @property
    def kind(self) -> str:
        return self.inner.kind

    @property
    def n_z(self) -> int:
        return len(self.prolongation)

    @property
    def n_a(self) -> int:
        return self.inner.n_a

    def step(self, states: Array, actions: Array) -> Array:
        inner = self.inner.step(_products(states, self.restriction.T), actions)
        return _products(inner, self.prolongation.T)

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        x, y = _products(states, self.restriction.T), _products(covectors, self.prolongation)
        on_inner, on_actions = self.inner.pull_back(x, actions, y)
        return _products(on_inner, self.restriction), on_actions

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        A, B = self.inner.linearise(self.restriction @ state, action)
        return self.prolongation @ A @ self.restriction, self.prolongation @ B

    def arrays(self) -> Arrays:
        inner = {_INNER + name: array for name, array in self.inner.arrays().items()}
        own = {"restriction": self.restriction, "prolongation": self.prolongation}
        return inner | own | {"form": np.array(self.FORM)}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> ProjectedModel:
        """The model of `arrays`."""
        inner = model_of(
            {name.removeprefix(_INNER): a for name, a in arrays.items() if name.startswith(_INNER)}
        )
        P = checked_array(arrays, "prolongation", "f", (None, inner.n_z))
        return cls(inner, checked_array(arrays, "restriction", "f", (inner.n_z, len(P))), P)


FORMS[ProjectedModel.FORM] = ProjectedModel.from_arrays


def _products(rows: Array, matrix: Array) -> Array:
    """rows @ matrix, one row after the other."""
    totals = np.zeros((len(rows), matrix.shape[1]))
    add_products(read_only(rows), read_only(matrix), totals)
    return totals


def fit_low_rank(samples: Samples, *, kind: str, most: int) -> ProjectedModel | None:
    """Least squares in at most `most` POD modes of the data, as many as the data determine."""
    n_a = samples.actions.shape[1]
    few = samples.thinned(_SNAPSHOTS).before
    largest = min(most, len(few), len(samples) // _SAMPLES_PER_MODE - n_a - 1)
    if largest < 1:
        return None
    energies, mixtures = np.linalg.eigh(few @ few.T)
    energies, mixtures = energies[::-1], mixtures[:, ::-1]
    kept = int(np.count_nonzero(energies > _ENERGY * max(energies[0], 0.0)))
    if not kept:
        return None
    V = np.linalg.qr(few.T @ mixtures[:, : min(kept, largest)])[0]
    steps = Samples(samples.before @ V, samples.actions, samples.after @ V)
    inner = fit_linear(steps, kind=kind, ridge=_LOW_RANK_RIDGE)
    return None if inner is None else ProjectedModel(inner, V.T, V)


def fit_coarse(
    samples: Samples, *, kind: str, shape: tuple[int, ...], ridge: float | None
) -> ProjectedModel | FiniteDifferenceModel | None:
    """`fit_finite_difference` on as fine a grid as is affordable."""
    n_z = samples.before.shape[1]
    components = n_z // math.prod(shape)
    fit = partial(fit_finite_difference, kind=kind, components=components, ridge=ridge)
    points, few = coarse_points(shape, _COARSE_POINTS)
    if few == shape:
        return fit(samples, shape=shape)
    every = (np.arange(components)[:, None] * math.prod(shape) + points).ravel()
    seen = Samples(samples.before[:, every], samples.actions, samples.after[:, every])
    inner = fit(seen, shape=few)
    if inner is None:
        return None
    some = samples.thinned(POINT_SAMPLES)
    states = np.concatenate([some.before, some.after])
    values = states[:, every]
    gram = values.T @ values
    gram[np.diag_indices(len(gram))] += COEFFICIENT_RIDGE * np.trace(gram) / len(gram)
    interpolation = np.linalg.solve(gram, values.T @ states).T
    if not np.isfinite(interpolation).all():
        return None
    return ProjectedModel(inner, np.eye(n_z)[every], interpolation)


def coarse_points(shape: tuple[int, ...], most: int) -> tuple[NDArray[np.int64], tuple[int, ...]]:
    """At most this many points of a grid, equally spaced along each axis, and how many along each.

    >>> coarse_points((4, 6), 6)
    (array([ 7,  9, 11, 19, 21, 23]), (2, 3))
    """
    spacing = [1] * len(shape)

    def sizes() -> list[int]:
        return [n // own for n, own in zip(shape, spacing, strict=True)]

    while math.prod(sizes()) > most:
        spacing[int(np.argmax(sizes()))] += 1
    numbers = np.arange(math.prod(shape)).reshape(shape)
    for axis, (size, own) in enumerate(zip(sizes(), spacing, strict=True)):
        numbers = np.take(numbers, own // 2 + own * np.arange(size), axis=axis)
    return numbers.ravel(), tuple(sizes())


FOREMOST = 60
"""Steps from whose readings x_0 is estimated, at most: later ones say nothing of it."""


@dataclass(frozen=True, eq=False)
class ReadingsModel(LinearModel):
    """A model in innovation form, as a linear model of its state; arrays as for `InnovationModel`."""

    FORM = "readings"
    SHAPES: ClassVar = LinearModel.SHAPES | {
        "C": "r n",
        "G": "n r",
        "U": "y r",
        "innovations": "r r",
    }
    C: Array
    G: Array
    U: Array
    innovations: Array

    def replay(self, readings: Array, actions: Array) -> tuple[Array, Array]:
        """The likeliest x_0 (n,) and the innovations (L, r) of readings and actions (L, ...)."""
        own = InnovationModel(
            self.A, self.B, self.C, self.G, self.U, self.innovations, past=0, d=self.constant
        )
        return own.replay(readings[: len(actions)] @ self.U, actions, FOREMOST)

    def foreseen(self, first: Array, actions: Array) -> Array:
        """U^T y_k (L, r) from x_0, without innovations."""
        x = driven(self.A, actions @ self.B.T + self.constant, first[:, None])[:-1, :, 0]
        return np.asarray(x @ self.C.T)


def fit_readings(
    rollouts: Sequence[Trajectory], target: Array, order: int
) -> tuple[ReadingsModel, float]:
    """The model of rollouts (readings (L + 1, n_y), actions (L, n_a)), and its error E.

    E is that of readings of rollouts that it was not fitted to, foreseen from x_0 without innovations,
    relative to sum |y - y_r|^2. It has a constant term if E is less with one. ValueError where the data
    determine no model.
    """
    found = [_fit_readings(rollouts, target, order, constant) for constant in (False, True)]
    return min(found, key=lambda one: one[1])


def _fit_readings(
    rollouts: Sequence[Trajectory], target: Array, order: int, constant: bool
) -> tuple[ReadingsModel, float]:
    whole = subspace_model(rollouts, order=order, constant=constant)
    model, missed, size = _model(whole), 0.0, 0.0
    for others, own in turns(rollouts, 2):
        try:
            half = _model(subspace_model(others, order=order, past=whole.past, constant=constant))
        except ValueError:
            return model, np.inf
        for y, a in own:
            first, _ = half.replay(y, a)
            with np.errstate(all="ignore"):
                wrong = half.foreseen(first, a) @ half.U.T - y[: len(a)]
            missed += float(np.sum(wrong**2))
            size += float(np.sum((y[: len(a)] - target) ** 2))
    return model, missed / size if size > 0.0 and np.isfinite(missed) else np.inf


def _model(found: InnovationModel) -> ReadingsModel:
    own = found.C, found.G, found.U, found.innovations
    return ReadingsModel("innovations", found.A, found.B, found.drift, *own)
