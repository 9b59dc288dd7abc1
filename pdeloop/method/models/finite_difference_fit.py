# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fit of an equation whose coefficients depend on the place.

As in `spectral_fit` a sampling time is integrated with the current equation and bent to end in the
measured state; the change z_{k+1} - z_k is then linear in the coefficients, each with the mean of its
feature on the way. Coefficients are the sum of one that all points share and a part of each point's
own, which a ridge holds at zero where the data say nothing of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import Samples
from pdeloop.method.models.columns import least_squares, orthonormal
from pdeloop.method.models.finite_difference import Feature, FiniteDifferenceModel, features_of
from pdeloop.method.models.settings import COEFFICIENT_RIDGE, POINT_SAMPLES, FieldModelSettings

_POINT_PASSES = 4
"""How often an equation of finite differences is refitted along the paths of the last fit."""
_POINT_REACH = 2.5
"""Fastest rate of a finite-difference model times its internal step, of a rule of order 4."""


def largest_rate(order: int) -> float:
    """The largest rate of a difference on a unit grid; order: 0, 1, 2, and on as of the model."""
    return 4.0 if order and order % 2 == 0 else 1.0


def fit_finite_difference(
    samples: Samples,
    *,
    kind: str,
    settings: FieldModelSettings,
    components: int = 1,
    ridge: float | None = None,
    degree: int = 3,
    shape: tuple[int, ...] = (),
) -> FiniteDifferenceModel | None:
    """The equation, or None where half of the samples overflow the first ones.

    ridge: of the points' own parts in normalised columns; None: they have none; shape: points of each
    axis, where there are several.
    """
    samples = samples.thinned(POINT_SAMPLES)
    features = features_of(components, degree, len(shape) or 1)
    size = largest_of(samples)
    model, fitted = nothing(kind, features, samples, components, shape), None
    for _ in range(_POINT_PASSES):
        data = Regression.along(model, samples)
        if data is None:
            break
        found = data.solved(coefficients(data.columns(), ridge), model)
        if found is None:
            break
        substeps = substeps_of(found, size, _POINT_REACH, settings)
        model = fitted = replace(found, substeps=substeps)
    return fitted


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
    return FiniteDifferenceModel(kind, features, C, np.zeros((n_z, n_a)), np.zeros(n_z), 8, shape)


def largest_of(samples: Samples) -> float:
    """The size of a field, for which internal steps are counted."""
    return float(np.quantile(np.abs(samples.before).max(axis=1), 0.9))


def substeps_of(
    model: FiniteDifferenceModel, size: float, reach: float, settings: FieldModelSettings
) -> int:
    """Enough internal steps for a field of that size, of `reach` over its fastest rate each.

    None for a map.
    """
    if not model.substeps:
        return 0
    growth = np.array(
        [len(m) * size ** (len(m) - 1) * largest_rate(j) for m, j, _ in model.features]
    )
    rate = float((np.abs(model.coefficients) * growth[:, None, None]).sum(axis=0).max())
    return int(np.clip(np.ceil(rate / reach), 2, settings.point_substeps))


@dataclass(frozen=True, eq=False)
class Columns:
    """The normal equations of each point, free of the inputs, in columns X with a sum of squares of 1.

    Attributes
    ----------
    gram, moment : (n_x, F, F) and (n_x, F, components) arrays
        X^T X and X^T y.
    square : float
        The sum of y^2 over all points.
    scale : (F,) array
        By which the columns were divided.
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
    """What a pass regresses.

    Attributes
    ----------
    X : (n_x, N, F) array
        Means of the features, weighted.
    y : (n_x, N, components) array
        The change to be explained.
    common : (N, n_a + 1) array
        The inputs and 1.
    miss : float
        Root of the mean square of what the steps of the model missed.
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
