# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A first law with an observer from a model of the field, by statistical linearisation.

The best law of the whole field on the model, a = K x + b with x = V^T z and V the POD modes of
simulated fields, is combined with a Kalman filter for the linear model that fits these simulations on
average,

    x_{k+1} = A x_k + B a_k + c + w_k,    y_k = C x_k + d + v_k,

A, c, C, d by least squares, B that of the model at the target. w is the residual of the regression plus
a share of the initial second moment per step, because a steady filter does not know when an episode
begins; v is the noise plus the part of a reading that the modes do not represent. A linearisation at
the target would have unstable modes in directions that no field takes.

Where few readings tell little of a nonlinear plant, a law on the filter's estimate may run away. So the
law is also mixed with the best law of the newest readings, a = D y + b, found by a descent on the model
from the regression of the actions on the readings.

The law starts with p_0 = U^T y_0. The compensator's coordinates are those in which this is the best
linear estimate of x_0 from the first readings.

References
----------
Booton, "Nonlinear control systems with random inputs", IRE Trans. Circuit Theory 1(1), 1954. Gelb
(ed.), "Applied Optimal Estimation", 1974, section 6.4 (statistical linearisation).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.adapt.estimated_loop import WholeFieldLaw
from pdeloop.method.adapt.improve import curvature_of, improve
from pdeloop.method.adapt.sensed_loop import SensedLoop
from pdeloop.method.adapt.settings import ModelBasedSettings
from pdeloop.method.design.lqg import kalman_filter
from pdeloop.method.design.lqt import DesignError
from pdeloop.method.models.sensed import SensedModel

SHARES = (0.01, 0.1, 1.0)
"""Shares of the initial second moment that count as process noise over an episode; each makes laws."""
ESTIMATED = (1.0, 0.5, 0.0)
"""Shares of the action that follow the filter's estimate; the rest follows the newest readings."""
RIDGE = 1e-6
"""Of the regressions, relative to the mean square of a mode."""
TOLD = 1e-2
"""Least singular value of the estimate of x_0 from readings, relative to the largest."""
LEAST = 1e-8
"""Least variance of a noise, relative to the mean square of a reading or a mode."""


def compensators(
    loop: SensedLoop, law: WholeFieldLaw, settings: ModelBasedSettings | None = None
) -> Iterator[Array]:
    """Theta (`LinearLoop`) of the law on the estimates of a Kalman filter, or of the newest readings.

    One for each of `SHARES` and `ESTIMATED`. settings: of the descent to the law of newest readings,
    which without them is the regression's.
    """
    model = loop.model
    assert isinstance(model, SensedModel)
    z, a = law.simulation.states, law.simulation.actions
    x, y = z @ law.loop.U, z[..., model.seen]
    n_s, steps = x.shape[2], len(a)
    weights = np.tile(law.weights / steps, steps)
    before = np.column_stack([x[:-1].reshape(-1, n_s), np.ones(weights.size)])
    B = law.loop.U.T @ model.linearise(loop.target, np.zeros(model.n_a))[1]
    moved = (x[1:] - x[:-1]).reshape(-1, n_s) - a.reshape(-1, a.shape[2]) @ B.T
    A, c, W = _regression(before, moved, weights)
    A = A + np.eye(n_s)
    C, d, V = _regression(before, y[:-1].reshape(-1, model.sensors), weights)
    first = x[0].T @ (law.weights[:, None] * x[0])
    noise = np.full(model.sensors, max(model.noise**2, LEAST * float(np.mean(y * y))))
    V = V + np.diag(noise)
    W = W + LEAST * np.trace(first) / n_s * np.eye(n_s)
    seen = y[0].T @ (law.weights[:, None] * y[0]) + np.diag(noise)
    guess = linalg.solve(seen, y[0].T @ (law.weights[:, None] * x[0]), assume_a="pos").T
    read = np.column_stack([y[:-1].reshape(-1, model.sensors), np.ones(weights.size)])
    D, own, _ = _regression(read, a.reshape(weights.size, -1), weights, np.append(noise, 0.0))
    if settings is not None:
        D, own = _of_readings(loop, D, own, z[0], law.weights, settings)
    K, b = law.theta[:, :-1], law.loop.constant_feature * law.theta[:, -1]
    for share in SHARES:
        try:
            M = kalman_filter(A, C, W + share / steps * first, V).M
        except DesignError:
            continue
        I_MC = np.eye(n_s) - M @ C
        after = A @ I_MC, A @ M, c - A @ M @ d
        for part in ESTIMATED:
            rows = part * K @ I_MC, part * K @ M, part * (b - K @ M @ d)
            rest = (1.0 - part) * D, (1.0 - part) * own
            mixed = rows[0], rows[1] + rest[0], rows[2] + rest[1]
            yield law_theta(loop, B, guess, mixed, after)


class _WithOffset(ClosedLoop):
    """A loop whose law has an offset of its own, whatever the target is."""

    constant_feature: ClassVar[float] = 1.0


def _of_readings(
    loop: SensedLoop,
    D: Array,
    own: Array,
    fields: Array,
    weights: Array,
    settings: ModelBasedSettings,
) -> tuple[Array, Array]:
    """The law a = D y + b of the newest readings of least cost on the model, from one to begin with."""
    model = loop.model
    assert isinstance(model, SensedModel)
    static = _WithOffset(
        model.at_sensors(np.eye(model.sensors)),
        loop.target,
        loop.state_weight,
        loop.action_weight,
        loop.horizon,
        loop.action_set,
        model=model,
        noise=loop.noise,
    )
    theta = np.column_stack([D, own])
    found = improve(static, theta, fields, weights, curvature_of(static), settings)
    if found is not None:
        theta = found.theta
    return theta[:, :-1], theta[:, -1]


def _regression(
    features: Array, wanted: Array, weights: Array, noise: Array | float = 0.0
) -> tuple[Array, Array, Array]:
    """Matrix and constant of the weighted regression on [x; 1], and the covariance of its residual.

    noise: variances of what will be added to the features.
    """
    weighted = features * weights[:, None]
    moment = features.T @ weighted
    n = len(moment) - 1
    moment[np.diag_indices(n)] += RIDGE * np.trace(moment[:n, :n]) / n
    moment[np.diag_indices(n + 1)] += noise
    found = linalg.solve(moment, weighted.T @ wanted, assume_a="pos")
    left = wanted - features @ found
    return found[:n].T, found[n], left.T @ (weights[:, None] * left)


def law_theta(
    loop: SensedLoop,
    B: Array,
    guess: Array,
    rows: tuple[Array, Array, Array],
    after: tuple[Array, Array, Array],
) -> Array:
    """Theta of a = K x + D y + b, x+ = F x + G y + B a + c, with p in place of x.

    guess (n_s, n_y): x_0 from y_0; rows [K D b]; after [F G c], without B a.
    """
    left, values, _ = linalg.svd(loop.law.model.U.T)
    rank = int(np.sum(values > 1e-9 * values[0]))
    inside, outside = left[:, :rank], left[:, rank:]
    readings = linalg.pinv(loop.law.model.U.T)  # of s
    # Readings that say nothing of x_0 move it a little, so that T has an inverse.
    turned, told, back = linalg.svd(guess @ readings @ inside, full_matrices=False)
    own = (turned * np.maximum(told, TOLD * told[0])) @ back
    other = linalg.svd(own)[0][:, rank:]
    # p = T x with p_0 = s_0.
    T = inside @ linalg.pinv(own) + outside @ other.T / told[0]
    back = linalg.inv(T)
    (K, D, b), (F, G, c) = rows, after
    K, D = K @ back, D @ readings
    F, G = T @ F @ back, T @ G @ readings
    # The law adds B a with the B of its own model.
    moved = T @ B - loop.law.model.B
    F, G, c = F + moved @ K, G + moved @ D, T @ c + moved @ b
    return np.block([[D, K, b[:, None]], [G, F, c[:, None]]])
