# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model of some directions or points of a state, as one of the whole state.

    z_{k+1} = P f(S z_k, a_k)

Of a large state S and P are POD modes, and f is linear. Fields on several axes may be modelled on a
coarser grid: S takes the values at some of the grid points, and P, the least-squares interpolation of
measured states, gives the whole field. Fields that a law can influence are smooth, whereas the work of
a step of f grows with the number of points, times that of the internal steps, which on half the spacing
is four times as large.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array, read_only
from pdeloop.method.models.base import Arrays, FieldModel, Samples, numbers_of
from pdeloop.method.models.finite_difference import FiniteDifferenceModel
from pdeloop.method.models.finite_difference_fit import fit_finite_difference
from pdeloop.method.models.linear import LinearModel, add_products
from pdeloop.method.models.settings import COEFFICIENT_RIDGE, POINT_SAMPLES

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
    """The model above.

    Attributes
    ----------
    inner : FieldModel
        f.
    restriction : (m, n_z) array
        S.
    prolongation : (n_z, m) array
        P.
    """

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
    def from_arrays(
        cls, arrays: Arrays, model_of: Callable[[Arrays], FieldModel]
    ) -> ProjectedModel:
        """The model of `arrays`; model_of: that of the inner one's."""
        inner = model_of(
            {name.removeprefix(_INNER): a for name, a in arrays.items() if name.startswith(_INNER)}
        )
        P = numbers_of(arrays, "prolongation", None, inner.n_z)
        return cls(inner, numbers_of(arrays, "restriction", inner.n_z, len(P)), P)


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
    x, after = samples.before @ V, samples.after @ V
    columns = np.hstack([x, samples.actions, np.ones((len(x), 1))])
    scale = np.sqrt(np.mean(columns**2, axis=0))
    scale = np.where(scale > 0.0, scale, 1.0)
    columns = columns / scale
    gram = columns.T @ columns / len(x) + _LOW_RANK_RIDGE * np.eye(len(scale))
    found = np.linalg.solve(gram, columns.T @ after / len(x)) / scale[:, None]
    if not np.isfinite(found).all():
        return None
    r = V.shape[1]
    parts = (found[:r].T, found[r : r + n_a].T, found[-1])
    return ProjectedModel(LinearModel(kind, *map(np.ascontiguousarray, parts)), V.T, V)


def fit_coarse(
    samples: Samples,
    *,
    kind: str,
    shape: tuple[int, ...],
    ridge: float | None,
) -> ProjectedModel | FiniteDifferenceModel | None:
    """The equation on as fine a grid as is affordable, or None where there is none.

    shape: points of each axis; kind, ridge: as for `fit_finite_difference`.
    """
    n_z = samples.before.shape[1]
    components = n_z // math.prod(shape)
    fit = partial(
        fit_finite_difference,
        kind=kind,
        components=components,
        ridge=ridge,
    )
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
