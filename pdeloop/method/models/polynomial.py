# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A polynomial model of a state that is no field on an axis, with products of state and action.

With the components of the state scaled by their own standard deviations, y = (z - m) / s, orthonormal
POD modes V of y, w = [V_q^T y; (a - m_a) / s_a] with the q leading ones, and all products of two of w,

    z_{k+1} = z_k + s (c + A V^T y_k + B (a_k - m_a) / s_a + H (w_k x w_k)).

A heater's I^2, a flow that carries a temperature, a conductance that a valve changes are such products.
The scale makes the fit independent of units. The ridges of A and of H, and q, are those of the smallest
error in predicting rollouts that were left out, and pieces of them.

References
----------
Peherstorfer, Willcox, "Data-driven operator inference for nonintrusive projection-based model
reduction", CMAME 306, 2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement, product
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pdeloop.jit.cache import cached_njit
from pdeloop.messages.arrays import Array, read_only
from pdeloop.method.models.base import (
    Arrays,
    Measured,
    StoredModel,
    errors,
    pieces,
    predicted,
    samples_of,
    usable,
)
from pdeloop.method.models.linear import add_products
from pdeloop.method.reduce.reduced_model import Samples, turns

LARGEST_STATE = 256
"""Numbers of a state up to which a polynomial is fitted."""
LEADING = (4, 8, 12)
"""Numbers q of modes in products that are tried."""
LINEAR_RIDGES = (1e-8, 1e-5)
PRODUCT_RIDGES = (1e-6, 1e-4, 1e-2)
"""Relative to the mean squares of their columns."""
_ACTION_RIDGE = 1e-8
_PIECE, _PARTS = 25, 3
"""Steps of a piece that is predicted, and parts of the rollouts, of which one is left out."""
_ROUNDING = 1e-9
"""Standard deviation of a component, relative to its mean, up to which it rests."""


@dataclass(frozen=True, eq=False)
class PolynomialModel(StoredModel):
    """The model above, with the centres m (n_z,) and m_a (n_a,) and the action's scale s_a (n_a,).

    V (n_z, r): diag(1/s) V, coordinates x = V^T (z - m); products (p, 2): pairs of numbers of
    [x; (a - m_a) / s_a] that are multiplied; coefficients (1 + r + n_a + p, n_z): of [1; x;
    (a - m_a) / s_a; products], s included.
    """

    FORM = "polynomial"
    SHAPES: ClassVar = {
        "centre": "n",
        "action_scale": "a",
        "V": "n r",
        "action_centre": "a",
        "products": "i:p 2",
        "coefficients": "f n",
    }
    kind: str
    V: Array
    centre: Array
    action_centre: Array
    action_scale: Array
    products: NDArray[np.int64]
    coefficients: Array

    @property
    def n_z(self) -> int:
        return len(self.centre)

    @property
    def n_a(self) -> int:
        return len(self.action_scale)

    def features(self, states: Array, actions: Array) -> Array:
        """[1; x; (a - m_a) / s_a; products] of each row, (M, 1 + r + n_a + p)."""
        r, n_a = self.V.shape[1], self.n_a
        found = np.zeros((len(states), len(self.coefficients)))
        found[:, 0] = 1.0
        x = np.zeros((len(states), r))
        add_products(read_only(states - self.centre), read_only(self.V), x)
        found[:, 1 : 1 + r] = x
        found[:, 1 + r : 1 + r + n_a] = (actions - self.action_centre) / self.action_scale
        w = found[:, 1 : 1 + r + n_a]
        found[:, 1 + r + n_a :] = w[:, self.products[:, 0]] * w[:, self.products[:, 1]]
        return found

    def step(self, states: Array, actions: Array) -> Array:
        after = np.array(states, dtype=np.float64)
        features = read_only(self.features(states, actions))
        add_products(features, read_only(self.coefficients), after)
        return after

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        r, n_a = self.V.shape[1], self.n_a
        on_features = np.zeros((len(states), len(self.coefficients)))
        add_products(read_only(covectors), read_only(self.coefficients.T), on_features)
        w = self.features(states, actions)[:, 1 : 1 + r + n_a]
        on_w = on_features[:, 1 : 1 + r + n_a].copy()
        add_slopes(read_only(w), read_only(on_features[:, 1 + r + n_a :]), self.products, on_w)
        on_states = np.array(covectors, dtype=np.float64)
        add_products(read_only(on_w[:, :r]), read_only(self.V.T), on_states)
        return on_states, on_w[:, r:] / self.action_scale

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Self:
        model = super().from_arrays(arrays)
        count, products = model.V.shape[1] + model.n_a, model.products
        if products.size and not (products.min() >= 0 and products.max() < count):
            raise ValueError(f"a model has products of numbers beyond its {count}")
        if len(model.coefficients) != 1 + count + len(products):
            raise ValueError(f"a model has {len(model.coefficients)} rows of coefficients")
        if not (model.action_scale > 0.0).all():
            raise ValueError("a model has a scale of actions that is not positive")
        return model


@cached_njit()
def add_slopes(w: Array, on_products: Array, products: NDArray[np.int64], totals: Array) -> None:
    """totals += (d products/dw)^T on_products, one row after the other."""
    for m in range(len(w)):
        for p in range(len(products)):
            i, j = products[p, 0], products[p, 1]
            totals[m, i] += on_products[m, p] * w[m, j]
            totals[m, j] += on_products[m, p] * w[m, i]


@dataclass(frozen=True, eq=False)
class _Scaled:
    """Samples with their scales and modes, of which models of several ridges are made."""

    samples: Samples
    centre: Array
    scale: Array
    modes: Array
    action_centre: Array
    action_scale: Array

    @staticmethod
    def of(samples: Samples) -> _Scaled:
        centre, action_centre = samples.before.mean(axis=0), samples.actions.mean(axis=0)
        scale, action_scale = samples.before.std(axis=0), samples.actions.std(axis=0)
        scale[scale <= _ROUNDING * np.abs(centre)] = np.inf  # a component that rests
        action_scale[action_scale == 0.0] = 1.0
        y = (samples.before - centre) / scale
        values, vectors = linalg.eigh(y.T @ y)
        kept = values[::-1] > 1e-12 * values[-1]
        modes = np.ascontiguousarray(vectors[:, ::-1][:, kept])
        return _Scaled(samples, centre, scale, modes, action_centre, action_scale)

    def empty(self, leading: int) -> PolynomialModel:
        """The model without coefficients."""
        r, n_a = self.modes.shape[1], len(self.action_scale)
        numbers = [*range(min(leading, r)), *range(r, r + n_a)]
        pairs = list(combinations_with_replacement(numbers, 2))
        return PolynomialModel(
            "polynomial",
            np.ascontiguousarray(self.modes / self.scale[:, None]),
            self.centre,
            self.action_centre,
            self.action_scale,
            np.array(pairs, dtype=np.int64).reshape(-1, 2),
            np.zeros((1 + r + n_a + len(pairs), len(self.centre))),
        )

    def fits(
        self, model: PolynomialModel, ridges: Sequence[tuple[float, float]]
    ) -> list[PolynomialModel]:
        """The model fitted with each pair of ridges, of the state and of products."""
        r, n_a = model.V.shape[1], model.n_a
        features = model.features(self.samples.before, self.samples.actions)
        size = np.sqrt(np.mean(features**2, axis=0))
        if r:  # small modes are held back
            size[1 : 1 + r] = np.sqrt(np.mean(features[:, 1 : 1 + r] ** 2))
        size[size == 0.0] = 1.0
        features /= size
        gram = features.T @ features / len(features)
        change = (self.samples.after - self.samples.before) / self.scale
        moment = features.T @ change / len(features)
        found = []
        for linear, of_products in ridges:
            counts = [1, r, n_a, len(size) - 1 - r - n_a]
            penalty = np.repeat([0.0, linear, _ACTION_RIDGE, of_products], counts)
            matrix = gram.copy()
            matrix[np.diag_indices(len(size))] += penalty + 1e-13
            solved = linalg.solve(matrix, moment, assume_a="pos") / size[:, None]
            solved *= np.where(np.isfinite(self.scale), self.scale, 0.0)
            found.append(replace(model, coefficients=np.ascontiguousarray(solved)))
        return found


def fit_polynomial(rollouts: Sequence[Measured]) -> PolynomialModel | None:
    """The polynomial that predicts rollouts, and pieces of them, best that it was not fitted to."""
    rollouts = usable([Measured(own.known, own.actions) for own in rollouts])
    samples = samples_of(rollouts)
    if len(samples) < 4 * _PARTS:
        return None
    short = len(rollouts) < _PARTS
    ridges = list(product(LINEAR_RIDGES, PRODUCT_RIDGES))
    n_z = samples.before.shape[1]
    leading = [q for i, q in enumerate(LEADING) if not i or LEADING[i - 1] < n_z]
    missed = np.zeros((len(leading), len(ridges)))
    for others, own in turns(_cut(rollouts) if short else rollouts, _PARTS):
        data = _Scaled.of(samples_of(others))
        # Whole rollouts tell what is unstable, and pieces what is wrong where nothing predicts those.
        both = [own] if short else [own, _cut(own)]
        for i, q in enumerate(leading):
            models = data.fits(data.empty(q), ridges)
            missed[i] += sum(_errors(models, parts, data.scale) for parts in both)
    i, j = divmod(int(np.argmin(missed)), len(ridges))
    data = _Scaled.of(samples)
    return data.fits(data.empty(leading[i]), [ridges[j]])[0]


def _cut(rollouts: Sequence[Measured]) -> list[Measured]:
    """In pieces of at most so many steps."""
    return [part for own in rollouts for part in pieces(own, -(-len(own.actions) // _PIECE))]


def _errors(models: Sequence[PolynomialModel], parts: Sequence[Measured], scale: Array) -> Array:
    """Mean square of the scaled error of each model over parts, relative to their change, at most 1."""
    found = np.empty((len(models), len(parts)))
    for row, model in zip(found, models, strict=True):
        for i, (own, states) in enumerate(zip(parts, predicted(model, parts), strict=True)):
            row[i] = errors(model, [own], own.states[0], 1.0, 0.0, 1.0 / scale, [states])[0]
    missed: Array = found.mean(axis=1)
    return missed
