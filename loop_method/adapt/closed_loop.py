# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws in a closed loop: their cost, and on a model of the whole field its exact gradient.

The law is a = theta [s; 1] with theta = [K_a b] and s = U^T z, saturated at the action limit. On a
model, from an initial field z_0, it costs

    J = 1/T sum_{k < T} (q |z_k - z_r|^2 + r |a_k|^2),        z_{k+1} = f(z_k, a_k),

with f the model. With eta_k = dJ/dz_k, eta_T = 0, the gradient follows backwards in time,

    g_k   = (df/da)^T eta_{k+1} + 2 r/T a_k        (0 where a_k is saturated),
    eta_k = (df/dz)^T eta_{k+1} + 2 q/T (z_k - z_r) + U K_a^T g_k,
    dJ/dtheta = sum_k g_k [s_k; 1]^T.

It costs about three simulations, whatever the number of gains.

References
----------
Griewank, Walther, "Evaluating Derivatives", SIAM 2008, chapter 3 (reverse mode).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from loop_interfaces.arrays import Array
from loop_interfaces.cost import Cost
from loop_method.adapt.base import Record
from loop_method.models import FieldModel


@dataclass(frozen=True, eq=False)
class ClosedLoopProblem:
    """Laws a = K_a U^T z + b, and their cost.

    Attributes
    ----------
    U : (n_z, n_s) array
        Basis of the projected state s = U^T z.
    target : (n_z,) array
        z_r.
    state_weight, action_weight : float
        q and r.
    horizon : int
        T, the steps of an episode.
    action_limit : float
        Magnitude at which actions saturate; 0 for none.
    """

    U: Array
    target: Array
    state_weight: float
    action_weight: float
    horizon: int
    action_limit: float = 0.0

    @cached_property
    def s_r(self) -> Array:
        """U^T z_r, (n_s,), as a plain sum like the controller's."""
        projected: Array = np.sum(self.U * self.target[:, None], axis=0)
        return projected

    @cached_property
    def constant_feature(self) -> float:
        """The last feature of the law: 0 where b = K_b s_r cannot be anything but 0, else 1."""
        inside = float(np.sum(self.s_r * self.s_r))
        return 1.0 if inside > 1e-20 * float(np.sum(self.target * self.target)) else 0.0

    def theta(self, policy: Array) -> Array:
        """[K_a b] of a policy [K_a K_b], (n_a, n_s + 1)."""
        n_s = self.U.shape[1]
        return np.column_stack([policy[:, :n_s], policy[:, n_s:] @ self.s_r])

    def policy(self, theta: Array, near: Array) -> Array:
        """[K_a K_b] of theta; among the K_b with the wanted b the one next to that of `near`."""
        n_s = self.U.shape[1]
        return self._changed(near, theta[:, :n_s], theta[:, n_s] - near[:, n_s:] @ self.s_r)

    def moved(self, policy: Array, step: Array) -> Array:
        """The policy after a step of theta; K_b moves least among those with the wanted b."""
        n_s = self.U.shape[1]
        return self._changed(policy, policy[:, :n_s] + step[:, :n_s], step[:, n_s])

    def _changed(self, policy: Array, K_a: Array, change: Array) -> Array:
        """The policy with other gains K_a, and with b changed by (n_a,)."""
        n_s, changed = self.U.shape[1], policy.copy()
        changed[:, :n_s] = K_a
        if self.constant_feature:
            changed[:, n_s:] += np.outer(change, self.s_r / float(np.sum(self.s_r * self.s_r)))
        return changed

    def mean_cost(self, states: Array, actions: Array) -> float:
        """Mean stage cost of states (..., n_z) and the actions (..., n_a) that answer them."""
        error = states - self.target
        cost = self.state_weight * np.sum(error * error)
        cost += self.action_weight * np.sum(actions * actions)
        return float(cost) / max(math.prod(actions.shape[:-1]), 1)

    def cost_of(self, record: Record) -> float:
        """Mean stage cost of the recorded part of a rollout."""
        return self.mean_cost(record.acted_from, record.actions)

    def mean_cost_of(self, records: Sequence[Record]) -> float:
        """The mean of their costs."""
        return float(np.mean([self.cost_of(record) for record in records]))


@dataclass(frozen=True, eq=False)
class ClosedLoop(ClosedLoopProblem):
    """A model of the whole field under such laws, and what they cost on it.

    Attributes
    ----------
    model : FieldModel
    noise : float
        Standard deviation of the noise on every number of the state that the law sees; 0 for none. It
        is the same in every simulation of as many fields.
    cost : Cost or None
        Another quadratic cost in place of that of q, r and z_r.
    """

    model: FieldModel = field(kw_only=True)
    noise: float = field(default=0.0, kw_only=True)
    cost: Cost | None = field(default=None, kw_only=True)

    def simulate(self, theta: Array, fields: Array) -> Simulation:
        """Roll theta (n_a, n_s + 1) out from the fields (F, n_z)."""
        K, b = theta[:, :-1], self.constant_feature * theta[:, -1]
        states = np.empty((self.horizon + 1, *fields.shape))
        actions = np.empty((self.horizon, len(fields), len(theta)))
        costs, finite = np.zeros(len(fields)), np.ones(len(fields), dtype=bool)
        noise = self._noise_of(len(fields))
        states[0] = fields
        with np.errstate(all="ignore"):
            for k in range(self.horizon):
                a = (states[k] @ self.U + noise[k]) @ K.T + b
                if self.action_limit:
                    np.clip(a, -self.action_limit, self.action_limit, out=a)
                self._add_stage(costs, states[k], states[k], a, k)
                # Diverged fields stay marked and continue with numbers that a model can take.
                finite &= np.isfinite(costs)
                a[~finite] = 0.0
                actions[k] = a
                after = self.model.step(states[k], a)
                finite &= np.isfinite(after).all(axis=1)
                after[~finite] = 0.0
                states[k + 1] = after
            if self.cost is not None:
                self.cost.add_terminal(costs, states[-1])
                finite &= np.isfinite(costs)
        costs /= self.horizon
        costs[~finite] = np.inf
        return Simulation(states, actions, costs)

    def _add_stage(self, costs: Array, z: Array, outputs: Array, a: Array, k: int) -> None:
        """Add the stage costs of step k, which are of z, or of the outputs that have a target."""
        if self.cost is not None:
            self.cost.add(costs, z, a, k)
            return
        error = outputs - self.target
        costs += self.state_weight * np.einsum("fi,fi->f", error, error)
        costs += self.action_weight * np.einsum("fi,fi->f", a, a)

    replays: ClassVar[bool] = False
    """True if initial fields are measured rollouts, with what in them was not foreseen."""

    def beginnings(self, records: Sequence[Record]) -> Array:
        """The initial field of each rollout, (n, n_z)."""
        return np.stack([record.states[0] for record in records])

    @property
    def no_control(self) -> Array:
        """Theta of a = 0."""
        return np.zeros((self.model.n_a, self.U.shape[1] + 1))

    def features(self, simulation: Simulation) -> Array:
        """What the law was of in a simulation, [s_k; 1], (T, F, n_s + 1)."""
        s = simulation.states[:-1] @ self.U
        return np.concatenate([s, np.full((*s.shape[:2], 1), self.constant_feature)], axis=2)

    def curvature(self, own: Array) -> Array:
        """What a change of the law's outputs costs, from that of an action, (n_a, n_a)."""
        return own

    def costs(self, theta: Array, fields: Array) -> Array:
        """J from each of the fields (F, n_z); infinite where the simulation is not finite."""
        return self.simulate(theta, fields).costs

    def gradient(self, theta: Array, fields: Array, weights: Array) -> tuple[float, Array]:
        """The weighted sum of the costs, and its gradient (n_a, n_s + 1).

        Infinite, with a gradient of zero, where a cost of positive weight is.
        """
        simulation = self.simulate(theta, fields)
        gradient = np.zeros_like(theta)
        if not np.isfinite(simulation.costs[weights > 0.0]).all():
            return np.inf, gradient
        states, actions = simulation.states, simulation.actions
        K, eta = theta[:, :-1], np.zeros_like(fields)
        weight = weights[:, None] / self.horizon
        if self.cost is not None:
            eta = weight * self.cost.terminal_slope(states[-1])
        noise = self._noise_of(len(fields))
        share = 2.0 / self.horizon * weights[:, None]
        for k in reversed(range(self.horizon)):
            z, a = states[k], actions[k]
            eta, g = self.model.pull_back(z, a, eta)
            if self.cost is None:
                on_z = self.state_weight * share * (z - self.target)
                on_a = self.action_weight * share * a
            else:
                on_z, on_a = (weight * slope for slope in self.cost.slopes(z, a, k))
            g = g + on_a
            if self.action_limit:
                g = g * (np.abs(a) < self.action_limit)
            eta = eta + on_z + g @ K @ self.U.T
            gradient[:, :-1] += g.T @ (z @ self.U + noise[k])
            gradient[:, -1] += self.constant_feature * g.sum(axis=0)
        counted = weights > 0.0
        return float(weights[counted] @ simulation.costs[counted]), gradient

    def _noise_of(self, count: int) -> Array:
        """The noise added to U^T z, whose columns are orthonormal, (T, count, n_s) or (T, 1, 1)."""
        if not self.noise:
            return np.zeros((self.horizon, 1, 1))
        size = self.horizon, count, self.U.shape[1]
        return self.noise * np.random.default_rng(0).standard_normal(size)


@dataclass(frozen=True, eq=False)
class Simulation:
    """States (T + 1, F, n_z), actions (T, F, n_a), and the mean stage cost of each field (F,).

    From where a field's simulation is not finite its states and actions are zero.
    """

    states: Array
    actions: Array
    costs: Array
