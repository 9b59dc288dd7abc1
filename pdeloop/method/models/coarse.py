# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An equation on a coarser grid, as a model of fields on several axes.

    z_{k+1} = P f(S z_k, a_k),

where S takes the values at some of the grid points, f is a `FiniteDifferenceModel` of them, and P, the
least-squares interpolation of measured states, gives the whole field. Fields that a law can influence
are smooth, whereas the work of a step of f grows with the number of points, times that of the internal
steps, which on half the spacing is four times as large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array, read_only
from pdeloop.method.models.base import Arrays, Samples, linearised, numbers_of, text_of
from pdeloop.method.models.finite_difference import FiniteDifferenceModel
from pdeloop.method.models.finite_difference_fit import fit_finite_difference
from pdeloop.method.models.linear import add_products
from pdeloop.method.models.settings import COEFFICIENT_RIDGE, POINT_SAMPLES, FieldModelSettings

Points = NDArray[np.int64]
_INNER = "inner."


@dataclass(frozen=True, eq=False)
class CoarseModel:
    """The model above.

    Attributes
    ----------
    inner : FiniteDifferenceModel
        f.
    points : (m,) array of int
        Numbers of a state that S takes.
    interpolation : (n_z, m) array
        P.
    """

    inner: FiniteDifferenceModel
    points: Points
    interpolation: Array

    @property
    def kind(self) -> str:
        return self.inner.kind

    @property
    def n_z(self) -> int:
        return len(self.interpolation)

    @property
    def n_a(self) -> int:
        return self.inner.n_a

    def step(self, states: Array, actions: Array) -> Array:
        coarse = self.inner.step(states[:, self.points], actions)
        after = np.zeros(states.shape)
        add_products(read_only(coarse), read_only(self.interpolation.T), after)
        return after

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        coarse = np.zeros((len(covectors), len(self.points)))
        add_products(read_only(covectors), read_only(self.interpolation), coarse)
        on_points, on_actions = self.inner.pull_back(states[:, self.points], actions, coarse)
        on_states = np.zeros(states.shape)
        on_states[:, self.points] = on_points
        return on_states, on_actions

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        return linearised(self, state, action)

    def arrays(self) -> Arrays:
        inner = {_INNER + n: array for n, array in self.inner.arrays().items() if n != "form"}
        own = {"points": self.points, "interpolation": self.interpolation}
        return inner | own | {"form": np.array("coarse"), "kind": np.array(self.kind)}

    @staticmethod
    def from_arrays(arrays: Arrays) -> CoarseModel:
        """The model of `arrays`."""
        inner = FiniteDifferenceModel.from_arrays(
            {name.removeprefix(_INNER): a for name, a in arrays.items() if name.startswith(_INNER)}
        )
        if text_of(arrays, "kind") != inner.kind:
            raise ValueError(f"a model '{text_of(arrays, 'kind')}' is made of one '{inner.kind}'")
        points = checked_array(arrays, "points", "i", (inner.n_z,))
        interpolation = numbers_of(arrays, "interpolation", None, inner.n_z)
        if points.min(initial=0) < 0 or points.max(initial=0) >= len(interpolation):
            raise ValueError(f"a model '{inner.kind}' has points outside of its state")
        return CoarseModel(inner, points.copy(), interpolation)


def coarse_points(shape: tuple[int, ...], most: int) -> tuple[Points, tuple[int, ...]]:
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


def fit_coarse(
    samples: Samples,
    *,
    kind: str,
    settings: FieldModelSettings,
    shape: tuple[int, ...],
    ridge: float | None,
    degree: int,
) -> CoarseModel | FiniteDifferenceModel | None:
    """The equation on as fine a grid as the settings allow, or None where there is none.

    shape: points of each axis; kind, ridge, degree: as for `fit_finite_difference`.
    """
    n_z = samples.before.shape[1]
    components = n_z // math.prod(shape)
    fit = partial(
        fit_finite_difference,
        kind=kind,
        settings=settings,
        components=components,
        ridge=ridge,
        degree=degree,
    )
    points, few = coarse_points(shape, settings.coarse_points)
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
    return CoarseModel(inner, every, np.ascontiguousarray(interpolation))
