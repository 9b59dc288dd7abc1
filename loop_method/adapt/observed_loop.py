# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer in a closed loop on a model: its cost, and the gradient through its memory.

With the memory p_k a part of the state, and its next value a second output of the law,

    [a_k; u_k] = Theta [s_k; p_k; 1],       Theta = [D K b; G F c],
    z_{k+1} = f(z_k, a_k),   p_{k+1} = u_k + B a_k,      p_0 = s_0,

a compensator is a static law of a larger plant, and the adjoint that of `closed_loop`: with eta_k and
mu_k the derivatives of the cost by z_k and p_k, backwards in time,

    g_k = (df/da)^T eta_{k+1} + B^T mu_{k+1} + 2 r/T a_k        (0 where a_k is saturated),
    dJ/dTheta = sum_k [g_k; mu_{k+1}] [s_k; p_k; 1]^T.

References
----------
El Ghaoui, Oustry, AitRami, "A cone complementarity linearization algorithm for static output-feedback
and related problems", IEEE Trans. Automatic Control 42(8), 1997, section IV (dynamic laws as static
ones).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import linalg

from loop_interfaces.arrays import Array
from loop_method.adapt.closed_loop import ClosedLoop, Simulation
from loop_method.laws.observer import Observer

ROUND = 1e-2
"""Share of the identity in what a change of the memory costs, which the gains alone leave out."""


@dataclass(frozen=True, eq=False)
class ObservedSimulation(Simulation):
    """With what the law was of, [s_k; p_k; 1], (T, F, 2 n_s + 1)."""

    features: Array


@dataclass(frozen=True, eq=False)
class ObservedLoop(ClosedLoop):
    """A model under laws with an observer.

    Attributes
    ----------
    law : Observer
        That of the reduced model; policies are its theta, and theta here is Theta.
    """

    law: Observer = field(kw_only=True)

    def theta(self, policy: Array) -> Array:
        """Theta (n_a + n_s, 2 n_s + 1) of the law's vector."""
        p = self.law.parts(np.ravel(policy))
        return np.block([[p["D"], p["K"], p["b"][:, None]], [p["G"], p["F"], p["c"][:, None]]])

    def policy(self, theta: Array, near: Array) -> Array:
        """The law's vector, of the shape of `near`."""
        n_a, n_s = self.law.n_a, len(self.law.model.A)
        (D, K, b), (G, F, c) = (
            np.split(rows, [n_s, 2 * n_s], axis=1) for rows in (theta[:n_a], theta[n_a:])
        )
        parts = {"D": D, "K": K, "b": b[:, 0], "G": G, "F": F, "c": c[:, 0]}
        return self.law.vector(parts).reshape(near.shape)

    @property
    def no_control(self) -> Array:
        """Theta of a = 0."""
        n_s = len(self.law.model.A)
        return np.zeros((self.law.n_a + n_s, 2 * n_s + 1))

    def features(self, simulation: Simulation) -> Array:
        """See `ObservedSimulation`."""
        assert isinstance(simulation, ObservedSimulation)
        return simulation.features

    def curvature(self, own: Array) -> Array:
        """What a change of [a; u] costs, from that of an action alone, (n_a, n_a).

        A prediction that is wrong by one moves the action by K.
        """
        K = self.law.model.K_a
        moved = K.T @ own @ K
        size = float(np.trace(moved)) / len(moved)
        moved[np.diag_indices(len(moved))] += ROUND * (size or 1.0)
        return np.asarray(linalg.block_diag(own, moved), dtype=np.float64)

    def _noise_of(self, count: int) -> Array:
        """What the noise adds to U^T z, whose columns need not be orthonormal."""
        drawn = super()._noise_of(count)
        if not self.noise:
            return drawn
        R = linalg.qr(self.U, mode="r")[0][: min(self.U.shape)]
        return np.asarray(drawn[..., : len(R)] @ R, dtype=np.float64)

    def _start(self, fields: Array) -> Array:
        """z_0."""
        return fields

    def _outputs(self, k: int, z: Array, fields: Array) -> Array:
        """What U^T is applied to, and the target is of."""
        return z

    def _pull_outputs(self, by_outputs: Array) -> Array:
        """The derivative by z of that by the outputs."""
        return by_outputs

    def _step(self, k: int, z: Array, a: Array, fields: Array) -> Array:
        return self.model.step(z, a)

    def simulate(self, theta: Array, fields: Array) -> ObservedSimulation:
        """Roll Theta out from the fields (F, n_z)."""
        n_a, B = self.law.n_a, self.law.model.B
        count, T = len(fields), self.horizon
        begin = self._start(fields)
        states = np.empty((T + 1, *begin.shape))
        actions, features = np.empty((T, count, n_a)), np.ones((T, count, theta.shape[1]))
        n_s = B.shape[0]
        costs, finite = np.zeros(count), np.ones(count, dtype=bool)
        noise = self._noise_of(count)
        states[0] = begin
        memory = np.zeros((count, n_s))
        with np.errstate(all="ignore"):
            for k in range(T):
                outputs = self._outputs(k, states[k], fields)
                s = outputs @ self.U + noise[k]
                features[k, :, :n_s] = s
                features[k, :, n_s:-1] = memory if k else s
                out = features[k] @ theta.T
                a = out[:, :n_a]
                if self.action_limit:
                    a = np.clip(a, -self.action_limit, self.action_limit)
                self._add_stage(costs, states[k], outputs, a, k)
                memory = out[:, n_a:] + a @ B.T
                finite &= np.isfinite(costs) & np.isfinite(memory).all(axis=1)
                a = np.where(finite[:, None], a, 0.0)
                memory[~finite] = 0.0
                features[k, ~finite] = 0.0
                actions[k] = a
                after = self._step(k, states[k], a, fields)
                finite &= np.isfinite(after).all(axis=1)
                after[~finite] = 0.0
                states[k + 1] = after
            if self.cost is not None:
                self.cost.add_terminal(costs, states[-1])
                finite &= np.isfinite(costs)
        costs /= T
        costs[~finite] = np.inf
        return ObservedSimulation(states, actions, costs, features)

    def gradient(self, theta: Array, fields: Array, weights: Array) -> tuple[float, Array]:
        """The weighted sum of the costs, and its gradient by Theta."""
        simulation = self.simulate(theta, fields)
        gradient = np.zeros_like(theta)
        if not np.isfinite(simulation.costs[weights > 0.0]).all():
            return np.inf, gradient
        states, actions, features = simulation.states, simulation.actions, simulation.features
        B = self.law.model.B
        n_s = len(B)
        eta, mu = np.zeros_like(states[0]), np.zeros((len(fields), n_s))
        weight = weights[:, None] / self.horizon
        if self.cost is not None:
            eta = weight * self.cost.terminal_slope(states[-1])
        for k in reversed(range(self.horizon)):
            z, a = states[k], actions[k]
            eta, g = self.model.pull_back(z, a, eta)
            if self.cost is None:
                error = self._outputs(k, z, fields) - self.target
                on_z = self._pull_outputs(2.0 * self.state_weight * weight * error)
                on_a = 2.0 * self.action_weight * weight * a
            else:
                on_z, on_a = (weight * slope for slope in self.cost.slopes(z, a, k))
            g = g + on_a + mu @ B
            if self.action_limit:
                g = g * (np.abs(a) < self.action_limit)
            out = np.hstack([g, mu])
            gradient += out.T @ features[k]
            by_features = out @ theta
            by_s, mu = by_features[:, :n_s], by_features[:, n_s:-1]
            eta = eta + on_z + self._pull_outputs((by_s if k else by_s + mu) @ self.U.T)
        counted = weights > 0.0
        return float(weights[counted] @ simulation.costs[counted]), gradient
