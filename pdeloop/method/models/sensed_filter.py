# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The extended Kalman filter of a field between few sensors.

For an equation z_{k+1} = f(z_k, a_k) and readings y_k = H z_k + v_k, v_k ~ N(0, sigma^2 I), the
estimate is z_k ~ N(x_k, S_k S_k^T). Plants without process noise keep errors in the directions that the
initial ones have, so that the filter carries the columns of S, as many as there are Fourier
coefficients of an initial field. At a reading

    D = I + N N^T,    N = S^T H^T / sigma,    S <- S D^{-1/2},    x <- x + S S^T H^T (y - H x) / sigma^2

with the new S in the last term. Of n_y readings D differs from I by the rank n_y at most: with the
eigenvectors V and values g of N^T N

    D^{-1/2} = I - N V diag(1 / (1 + g + sqrt(1 + g))) V^T N^T,    D^{-1} N = N V diag(1 / (1 + g)) V^T.

Over a step

    x <- f(x, a),    S <- kappa (df/dz) S,

the derivatives by differences. The inflation kappa >= 1 forgets what the linearisation misses.

References
----------
Anderson, Moore, "Optimal Filtering", 1979, section 8.2 (extended Kalman filter). Pham, Verron, Roubaud,
"A singular evolutive extended Kalman filter for data assimilation in oceanography", J. Marine Systems
16, 1998 (a covariance of low rank).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models.sensed import SensedModel, field_of

_DIFFERENCE = 1e-4
"""Step of the differences along the columns of S, relative to them."""
_LEAST = 1e-6
"""Least sigma, relative to the largest standard deviation of a coefficient."""


@dataclass(frozen=True, eq=False)
class SensedFilter:
    """The filter of a model, for any number of environments at once.

    Attributes
    ----------
    model : SensedModel
        f and H.
    mean : (33,) array
        That of the Fourier coefficients of an initial field.
    factor : (33, 33) array
        The columns of a square root of their covariance, as rows.
    noise : float
        sigma: of the noise of a reading, and of what the model does not predict of it.
    inflation : float
        kappa.
    """

    model: SensedModel
    mean: Array
    factor: Array
    noise: float
    inflation: float

    @cached_property
    def start(self) -> tuple[Array, Array]:
        """x (n,) and the columns of S as rows, (33, n), before the first reading."""
        n = self.model.n_z
        return field_of(self.mean, n), field_of(self.factor, n)

    @cached_property
    def sigma(self) -> float:
        """That of the noise, but large enough to divide by."""
        return max(self.noise, _LEAST * float(np.abs(self.factor).max()), 1e-12)

    def measured(self, x: Array, S: Array, y: Array) -> tuple[Array, Array]:
        """After a reading: x (M, n), S (M, 33, n) and y (M, n_y)."""
        seen, sigma = self.model.seen, self.sigma
        H = S[:, :, seen] / sigma
        G = H.swapaxes(1, 2) @ H
        missed = (y - x[:, seen]) / sigma
        # What has overflowed stays so: LAPACK takes finite numbers only.
        lost = ~(np.isfinite(G).all(axis=(1, 2)) & np.isfinite(missed).all(axis=1))
        H[lost], G[lost], missed[lost] = 0.0, 0.0, 0.0
        values, V = np.linalg.eigh(G)
        inflated = 1.0 + np.maximum(values, 0.0)[:, :, None]
        told = V @ ((V.swapaxes(1, 2) @ missed[:, :, None]) / inflated)
        x = x + ((H @ told).swapaxes(1, 2) @ S)[:, 0]
        root = np.sqrt(inflated).swapaxes(1, 2)
        S = S - (H @ V / (root + root * root)) @ (V.swapaxes(1, 2) @ (H.swapaxes(1, 2) @ S))
        return np.where(lost.reshape(-1, 1), np.nan, x), S

    def predicted(self, x: Array, S: Array, a: Array) -> tuple[Array, Array]:
        """After a step under the actions a (M, n_a)."""
        count, columns, n = S.shape
        near = (x[:, None] + _DIFFERENCE * S).reshape(-1, n)
        after = self.model.step(
            np.concatenate([x, near]), np.concatenate([a, np.repeat(a, columns, axis=0)])
        )
        x, moved = after[:count].copy(), after[count:].reshape(S.shape)
        return x, self.inflation / _DIFFERENCE * (moved - x[:, None])
