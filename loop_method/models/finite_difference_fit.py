# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fit of an equation whose coefficients depend on the place.

As in `spectral_fit` a sampling time is integrated with the current equation and bent to end in the
measured state; the change z_{k+1} - z_k is then linear in the coefficients, each with the mean of its
feature on the way. Coefficients are the sum of one that all points share and a part of each point's
own, which a ridge holds at zero where the data say nothing of it.
"""

from __future__ import annotations

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.models.base import Samples
from loop_method.models.columns import least_squares, orthonormal
from loop_method.models.finite_difference import FiniteDifferenceModel, features_of
from loop_method.models.settings import FieldModelSettings


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
    samples = samples.thinned(settings.point_samples)
    (count, n_z), n_a = samples.before.shape, samples.actions.shape[1]
    n_x, features = n_z // components, features_of(components, degree, len(shape) or 1)
    size = np.quantile(np.abs(samples.before).max(axis=1), 0.9)
    growth = np.array([len(m) * size ** (len(m) - 1) * largest_rate(j) for m, j in features])
    root = samples.weights()
    change = (samples.after - samples.before) * root[:, None]
    C, B, c = np.zeros((len(features), components, n_x)), np.zeros((n_z, n_a)), np.zeros(n_z)
    model, fitted = FiniteDifferenceModel(kind, features, C, B, c, 8, shape), None
    for _ in range(settings.point_passes):
        means, miss = model.means(samples.before, samples.actions, samples.after)
        ok = np.isfinite(means).all(axis=(1, 2)) & np.isfinite(miss).all(axis=1)
        if 2 * ok.sum() < count:
            break
        X = (means[ok] * root[ok, None, None]).transpose(2, 0, 1)  # (n_x, N, F)
        y = change[ok].reshape(-1, components, n_x).transpose(2, 0, 1)  # (n_x, N, components)
        common = np.hstack([samples.actions, np.ones((count, 1))])[ok] * root[ok, None]
        C = _coefficients(X, y, common, ridge, settings)
        inputs = least_squares(common, (y - X @ C).transpose(1, 0, 2).reshape(len(common), -1))
        if not (np.isfinite(C).all() and np.isfinite(inputs).all()):
            break
        inputs = inputs.reshape(n_a + 1, n_x, components).transpose(2, 1, 0).reshape(n_z, n_a + 1)
        C = np.ascontiguousarray(C.transpose(1, 2, 0))
        rate = float((np.abs(C) * growth[:, None, None]).sum(axis=0).max())
        substeps = int(np.clip(np.ceil(rate / settings.point_reach), 2, settings.point_substeps))
        B, c = np.ascontiguousarray(inputs[:, :-1]), np.ascontiguousarray(inputs[:, -1])
        model = fitted = FiniteDifferenceModel(kind, features, C, B, c, substeps, shape)
    return fitted


def _coefficients(
    X: Array, y: Array, common: Array, ridge: float | None, settings: FieldModelSettings
) -> Array:
    """Coefficients of every point, (n_x, F, components)."""
    basis = orthonormal(common)
    X, y = (values - basis @ (basis.T @ values) for values in (X, y))
    scale = np.sqrt(np.sum(X**2, axis=(0, 1)))
    scale = np.where(scale > 0.0, scale, 1.0)
    X = X / scale
    gram, moment = X.transpose(0, 2, 1) @ X, X.transpose(0, 2, 1) @ y
    eye = np.eye(X.shape[2])
    shared = np.linalg.solve(
        gram.sum(axis=0) + settings.coefficient_ridge * eye, moment.sum(axis=0)
    )
    found = np.broadcast_to(shared, moment.shape)
    if ridge is not None:
        own = np.linalg.solve(gram + ridge / len(X) * eye, moment - gram @ shared)
        found = found + own
    coefficients: Array = found / scale[:, None]
    return coefficients
