# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The exact derivative of a closed loop through the filter of its state, for given gains L_k.

With f the plant, g the filter's model of it, and H the sensors,

    y_k = H z_k + v_k,      x_k = w_k + L_k (y_k - H w_k),      a_k = K U^T x_k + b,
    z_{k+1} = f(z_k, a_k),  w_{k+1} = g(x_k, a_k),

w_0 the mean of initial fields, and the nearest admissible action P(a_k) in place of a_k. The gains are
those of an extended Kalman filter (`loop_method.models.sensed_filter`) under the law to begin with: how
they change with the law is left out. With eta_k = dJ/dz_k and omega_k = dJ/dw_k, both 0 at k = T,

    g_k     = (df/da)^T eta_{k+1} + (dg/da)^T omega_{k+1} + 2 r/T a_k      times (dP/da)^T,
    xi_k    = (dg/dx)^T omega_{k+1} + U K^T g_k,
    omega_k = (I - L_k H)^T xi_k,
    eta_k   = (df/dz)^T eta_{k+1} + 2 q/T (z_k - z_r) + H^T L_k^T xi_k,
    dJ/dK   = sum_k g_k x_k^T U,        dJ/db = sum_k g_k.

On the plants of an ensemble f differs from g, which a law has to withstand: an equation is never exact.

References
----------
Griewank, Walther, "Evaluating Derivatives", SIAM 2008, chapter 3 (reverse mode).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.closed_loop import ClosedLoop, Simulation
from loop_method.adapt.estimated_loop import simulate_estimated
from loop_method.adapt.improve import curvature_of, improve
from loop_method.adapt.settings import ModelBasedSettings
from loop_method.laws.extended_kalman import ExtendedKalman
from loop_method.models.sensed import SensedModel
from loop_method.models.sensed_filter import SensedFilter


@dataclass(frozen=True, eq=False)
class FilteredLoop(ClosedLoop):
    """Laws of the filter's estimate; theta is [K b], and noise the standard deviation of v_k.

    Attributes
    ----------
    known : SensedFilter
        g, H and w_0.
    gains : sequence of T arrays (F, n, n_y)
        L_k of each of the fields that are simulated, which are always these.
    """

    known: SensedFilter = field(kw_only=True)
    gains: Sequence[Array] = field(kw_only=True)

    def simulate(self, theta: Array, fields: Array) -> Simulation:
        return self._estimated(theta, fields)[0]

    def _estimated(self, theta: Array, fields: Array) -> tuple[Simulation, Array]:
        """The simulation, and x_k, (T, F, n)."""
        g, T, count = self.known.model, self.horizon, len(fields)
        K, b = theta[:, :-1], self.constant_feature * theta[:, -1]
        states, estimates = np.zeros((T + 1, *fields.shape)), np.zeros((T, *fields.shape))
        actions = np.zeros((T, count, g.n_a))
        features = np.full((T, count, len(K.T) + 1), self.constant_feature)
        costs, finite = np.zeros(count), np.ones(count, dtype=bool)
        noise = self.noise * np.random.default_rng(0).standard_normal((T, count, g.sensors))
        states[0] = fields
        x = np.repeat(self.known.start[0][None], count, axis=0)
        with np.errstate(all="ignore"):
            for k in range(T):
                z = states[k]
                missed = z[:, g.seen] + noise[k] - x[:, g.seen]
                x = x + np.einsum("fnj,fj->fn", self.gains[k], missed)
                features[k, :, :-1] = s = x @ self.U
                a = s @ K.T + b
                self.action_set.project(a, out=a)
                self._add_stage(costs, z, z, a, k)
                finite &= np.isfinite(costs) & np.isfinite(x).all(axis=1)
                for part in (a, x, features[k, :, :-1]):
                    part[~finite] = 0.0
                estimates[k], actions[k] = x, a
                after, x = self.model.step(z, a), g.step(x, a)
                finite &= np.isfinite(after).all(axis=1) & np.isfinite(x).all(axis=1)
                after[~finite] = x[~finite] = 0.0
                states[k + 1] = after
        costs /= T
        costs[~finite] = np.inf
        return Simulation(states, actions, costs, features), estimates

    def gradient(self, theta: Array, fields: Array, weights: Array) -> tuple[float, Array]:
        simulation, estimates = self._estimated(theta, fields)
        gradient, counted = np.zeros_like(theta), weights > 0.0
        if not np.isfinite(simulation.costs[counted]).all():
            return np.inf, gradient
        g, back = self.known.model, self.U @ theta[:, :-1].T
        gains, constant = theta[:, :-1], self.constant_feature * theta[:, -1]
        eta, omega = np.zeros_like(fields), np.zeros_like(fields)
        share = 2.0 / self.horizon * weights[:, None]
        for k in reversed(range(self.horizon)):
            z, a = simulation.states[k], simulation.actions[k]
            eta, by_plant = self.model.pull_back(z, a, eta)
            xi, by_filter = g.pull_back(estimates[k], a, omega)
            by_a = by_plant + by_filter + self.action_weight * share * a
            if self.action_set.bounded:
                requested = simulation.features[k, :, :-1] @ gains.T + constant
                by_a = self.action_set.pull_back(requested, by_a)
            gradient[:, :-1] += by_a.T @ simulation.features[k, :, :-1]
            gradient[:, -1] += self.constant_feature * by_a.sum(axis=0)
            xi += by_a @ back.T
            by_y = np.einsum("fnj,fn->fj", self.gains[k], xi)
            eta += self.state_weight * share * (z - self.target)
            eta[:, g.seen] += by_y
            xi[:, g.seen] -= by_y
            omega = xi
        return float(weights[counted] @ simulation.costs[counted]), gradient


def improve_through_filter(
    loop: ClosedLoop,
    law: ExtendedKalman,
    theta: Array,
    modes: Array,
    fields: Array,
    weights: Array,
    settings: ModelBasedSettings,
) -> tuple[Array, int]:
    """A law on an estimate after a descent, and its steps; itself where a simulation is not finite.

    loop: the plants, and the cost. modes: (n, m), what of the estimate is fed back.
    """
    # A descent leaves fields of no weight out, but each has its gains and its plant.
    fields, weights = fields[weights > 0.0], weights[weights > 0.0]
    parts, model = dict(law.parts(theta)), loop.model
    known = law.filter(parts)
    assert isinstance(model, SensedModel) and known is not None
    gains: list[Array] = []
    start = simulate_estimated(loop, law, theta, fields, gains)
    if not np.isfinite(start.costs).all():
        return theta, 0
    filtered = FilteredLoop(
        modes,
        loop.target,
        loop.state_weight,
        loop.action_weight,
        loop.horizon,
        loop.action_set,
        model=model,
        known=known,
        gains=gains,
        noise=loop.noise,
    )
    begin = np.column_stack([parts["K_e"] @ modes, parts["b"]])
    if not np.isfinite(filtered.costs(begin, fields)).all():
        return theta, 0
    few = replace(settings, iterations=settings.filter_iterations)
    found = improve(filtered, begin, fields, weights, curvature_of(filtered), few)
    if found is None:
        return theta, 0
    b = filtered.constant_feature * found.theta[:, -1]
    return law.vector(parts | {"K_e": found.theta[:, :-1] @ modes.T, "b": b}), found.steps
