# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws in a closed loop: their cost, and on a model of the plant its exact gradient.

The law is linear in the projected state s = U^T z and its memory p, and returns the action and the
input of the memory:

    [a_k; u_k] = theta [s_k; p_k; 1],        z_{k+1} = f(z_k, a_k),        p_{k+1} = u_k + B a_k,

with f the model, p_0 = s_0, and the nearest admissible action P(a_k) in place of a_k
(`loop_interfaces.action_set`). The affine law has no memory, and theta = [K_a b]; `observed_loop` has
that of a law with an observer. From an initial field z_0 the cost is

    J = 1/T sum_{k < T} (q |z_k - z_r|^2 + r |a_k|^2).

With eta_k = dJ/dz_k and mu_k = dJ/dp_k, both 0 at k = T, the gradient follows backwards in time,

    g_k     = (df/da)^T eta_{k+1} + B^T mu_{k+1} + 2 r/T a_k        times (dP/da)^T,
    [v; mu_k] = [theta_s theta_p]^T [g_k; mu_{k+1}],
    eta_k   = (df/dz)^T eta_{k+1} + 2 q/T (z_k - z_r) + U v,
    dJ/dtheta = sum_k [g_k; mu_{k+1}] [s_k; p_k; 1]^T.

It costs about three simulations, whatever the number of gains.

References
----------
Griewank, Walther, "Evaluating Derivatives", SIAM 2008, chapter 3 (reverse mode).
El Ghaoui, Oustry, AitRami, "A cone complementarity linearization algorithm for static output-feedback
and related problems", IEEE Trans. Automatic Control 42(8), 1997, section IV (a law with memory is a
static law of a larger plant).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.action_set import ANY_ACTION, ActionSet
from loop_interfaces.arrays import Array
from loop_interfaces.cost import Cost
from loop_method.adapt.base import Record
from loop_method.laws.feedforward import FeedForward
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
    action_set : ActionSet
        Admissible actions, the nearest of which is applied.
    """

    U: Array
    target: Array
    state_weight: float
    action_weight: float
    horizon: int
    action_set: ActionSet = ANY_ACTION

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


@dataclass(frozen=True, eq=False)
class ClosedLoop(ClosedLoopProblem):
    """A model of the plant under such laws, and their cost on it.

    A class derived from it says how a law remembers, or what of a model's state is seen.

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

    @property
    def constants(self) -> int:
        """Columns of theta that are constant parts: 1, or one for each step."""
        return 1

    replays: ClassVar[bool] = False
    """True if initial fields are measured rollouts, with what in them was not foreseen."""

    def beginnings(self, records: Sequence[Record]) -> Array:
        """The initial field of each rollout, (n, n_z)."""
        return np.stack([record.states[0] for record in records])

    def replays_of(self, records: Sequence[Record]) -> Array:
        """Initial fields with which a simulation repeats measured rollouts under their own laws.

        Rows [z_0, e_0, .., e_{T-1}], (n, n_z (T + 1)), with e_k = z_{k+1} - f(z_k, a_k); 0 where
        nothing was measured, or the model is not finite.
        """
        found = np.zeros((len(records), self.horizon + 1, self.model.n_z))
        for row, record in zip(found, records, strict=True):
            steps = min(len(record.actions), len(record.states) - 1, self.horizon)
            row[0] = record.states[0]
            with np.errstate(all="ignore"):
                after = self.model.step(record.states[:steps], record.actions[:steps])
            row[1 : steps + 1] = np.nan_to_num(
                record.states[1 : steps + 1] - after, nan=0.0, posinf=0.0, neginf=0.0
            )
        return found.reshape(len(records), -1)

    @property
    def memory_input(self) -> Array:
        """B of the memory, (n_p, n_a); n_p = 0: the law has none."""
        return np.zeros((0, self.model.n_a))

    @property
    def no_control(self) -> Array:
        """Theta of a = 0."""
        n_p = len(self.memory_input)
        return np.zeros((self.model.n_a + n_p, self.U.shape[1] + n_p + self.constants))

    def curvature(self, own: Array) -> Array:
        """Cost matrix of a change of the law's outputs [a; u], from that of an action, (n_a, n_a)."""
        return own

    def costs(self, theta: Array, fields: Array) -> Array:
        """J from each of the fields (F, n_z); infinite where the simulation is not finite."""
        return self.simulate(theta, fields).costs

    def simulate(self, theta: Array, fields: Array) -> Simulation:
        """Roll theta (n_a + n_p, n_s + n_p + constants) out from the fields (F, n_z)."""
        B, T, count = self.memory_input, self.horizon, len(fields)
        (n_p, n_a), n_s = B.shape, self.U.shape[1]
        begin = self._start(fields)
        states = np.empty((T + 1, *begin.shape))
        actions = np.empty((T, count, n_a))
        features = np.full((T, count, n_s + n_p + 1), self.constant_feature)
        costs, finite, all_finite = np.zeros(count), np.ones(count, dtype=bool), True
        noise = self._noise_of(count)
        gains, constants = theta[:, : n_s + n_p].T, self.constant_feature * theta[:, n_s + n_p :]
        states[0] = begin
        memory = np.empty((count, n_p))
        with np.errstate(all="ignore"):
            for k in range(T):
                outputs = self._outputs(k, states[k], fields)
                known = features[k, :, :-1]
                known[:, :n_s] = s = outputs @ self.U + noise[k]
                known[:, n_s:] = memory if k else s[:, :n_p]
                out = known @ gains + constants[:, min(k, self.constants - 1)]
                a = out[:, :n_a]
                self.action_set.project(a, out=a)
                self._add_stage(costs, states[k], outputs, a, k)
                memory = out[:, n_a:] + a @ B.T
                # Diverged fields stay marked and continue with numbers that a model can take.
                if not (all_finite and np.isfinite(costs).all() and np.isfinite(memory).all()):
                    all_finite = False
                    finite &= np.isfinite(costs) & np.isfinite(memory).all(axis=1)
                    for part in (a, memory, known):
                        part[~finite] = 0.0
                actions[k] = a
                after = self._step(k, states[k], a, fields)
                if not (all_finite and np.isfinite(after).all()):
                    all_finite = False
                    finite &= np.isfinite(after).all(axis=1)
                    after[~finite] = 0.0
                states[k + 1] = after
            if self.cost is not None:
                self.cost.add_terminal(costs, states[-1])
                finite &= np.isfinite(costs)
        costs /= T
        costs[~finite] = np.inf
        return Simulation(states, actions, costs, features)

    def gradient(
        self, theta: Array, fields: Array, weights: Array, simulation: Simulation | None = None
    ) -> tuple[float, Array]:
        """The weighted sum of the costs, and its gradient, of the shape of theta.

        Infinite, with a gradient of zero, where a cost of positive weight is.

        simulation: of theta from the fields, if there is one.
        """
        simulation = self.simulate(theta, fields) if simulation is None else simulation
        gradient = np.zeros_like(theta)
        if not np.isfinite(simulation.costs[weights > 0.0]).all():
            return np.inf, gradient
        states, actions = simulation.states, simulation.actions
        B, n_s = self.memory_input, self.U.shape[1]
        n_f = n_s + len(B)
        gains, constants = theta[:, :n_f], self.constant_feature * theta[:, n_f:]
        eta, mu = np.zeros_like(states[0]), np.zeros((len(fields), len(B)))
        weight = weights[:, None] / self.horizon
        if self.cost is not None:
            eta = weight * self.cost.terminal_slope(states[-1])
        share = 2.0 / self.horizon * weights[:, None]
        state_share, action_share = self.state_weight * share, self.action_weight * share
        for k in reversed(range(self.horizon)):
            z, a = states[k], actions[k]
            eta, g = self.model.pull_back(z, a, eta)
            if self.cost is None:
                error = self._outputs(k, z, fields) - self.target
                on_z, on_a = self._pull_outputs(state_share * error), action_share * a
            else:
                on_z, on_a = (weight * slope for slope in self.cost.slopes(z, a, k))
            g = g + on_a + mu @ B
            row = min(k, self.constants - 1)
            if self.action_set.bounded:
                requested = simulation.features[k, :, :-1] @ gains.T + constants[:, row]
                g = self.action_set.pull_back(requested[:, : a.shape[1]], g)
            out = np.hstack([g, mu])
            gradient[:, :n_f] += out.T @ simulation.features[k, :, :-1]
            gradient[:, n_f + row] += self.constant_feature * out.sum(axis=0)
            known = out @ gains
            by_s, mu = known[:, :n_s], known[:, n_s:]
            if k == 0:
                by_s[:, : len(B)] += mu
            eta = eta + on_z + self._pull_outputs(by_s @ self.U.T)
        counted = weights > 0.0
        return float(weights[counted] @ simulation.costs[counted]), gradient

    def unsaturated(self, theta: Array, fields: Array, weights: Array) -> Array:
        """The law with less excess where an action is at a bound from all fields, nearly the same one.

        There the cost does not depend on theta. The mean excess over the bound is taken from the
        constants, so that actions are on both sides of it.
        """
        simulation, n_a = self.simulate(theta, fields), self.model.n_a
        n_f = theta.shape[1] - self.constants
        requested = simulation.features[:, :, :-1] @ theta[:n_a, :n_f].T
        requested += self.constant_feature * theta[:n_a, n_f:].T[:, None][: self.horizon]
        excess = requested - simulation.actions
        if self.constants == 1:
            excess = excess.reshape(1, -1, n_a)
            weights = np.tile(weights, self.horizon) / self.horizon
        always = (excess != 0.0).all(axis=1)
        excess = np.where(always, np.einsum("kfi,f->ki", excess, weights), 0.0)
        changed = theta.copy()
        changed[:n_a, n_f:] -= excess.T
        return changed

    def moment(self, simulation: Simulation, weights: Array) -> Array:
        """F, the mean of [s; p; 1][s; p; 1]^T over steps and weighted fields."""
        features = simulation.features
        found: Array = np.einsum("kfi,kfj,f->ij", features, features, weights) / len(features)
        return found

    def _start(self, fields: Array) -> Array:
        """The model's state at the beginning; replayed rollouts have innovations after it."""
        return fields[:, : len(self.U)]

    def _outputs(self, k: int, z: Array, fields: Array) -> Array:
        """What U^T is applied to, and the target is of."""
        return z

    def _pull_outputs(self, by_outputs: Array) -> Array:
        """The derivative by z of that by the outputs."""
        return by_outputs

    def _step(self, k: int, z: Array, a: Array, fields: Array) -> Array:
        after, n_z = self.model.step(z, a), len(self.U)
        if fields.shape[1] > n_z:
            after = after + fields[:, n_z * (k + 1) : n_z * (k + 2)]
        return after

    def _add_stage(self, costs: Array, z: Array, outputs: Array, a: Array, k: int) -> None:
        """Add the stage costs of step k, which are of z, or of the outputs that have a target."""
        if self.cost is not None:
            self.cost.add(costs, z, a, k)
            return
        error = outputs - self.target
        costs += self.state_weight * np.einsum("fi,fi->f", error, error)
        costs += self.action_weight * np.einsum("fi,fi->f", a, a)

    def _noise_of(self, count: int) -> Array:
        """The noise added to U^T z, whose columns are orthonormal, (T, count, n_s) or (T, 1, 1)."""
        if not self.noise:
            return np.zeros((self.horizon, 1, 1))
        size = self.horizon, count, self.U.shape[1]
        return self.noise * np.random.default_rng(0).standard_normal(size)


@dataclass(frozen=True, eq=False)
class Simulation:
    """States (T + 1, F, n_z), actions (T, F, n_a), mean stage costs (F,) and features (T, F, n_f).

    The features are what the law was of, [s_k; p_k; 1]. From where a field's simulation is not finite
    its states, its actions and what the law knew of it are zero.
    """

    states: Array
    actions: Array
    costs: Array
    features: Array

    def of_fields(self, chosen: NDArray[Any]) -> Simulation:
        """Of some of the fields."""
        return Simulation(
            self.states[:, chosen],
            self.actions[:, chosen],
            self.costs[chosen],
            self.features[:, chosen],
        )


@dataclass(frozen=True, eq=False)
class FeedForwardLoop(ClosedLoop):
    """Laws a_k = K U^T z_k + b_k; theta is [K b_0 .. b_{T-1}].

    Attributes
    ----------
    law : FeedForward
        Whose vector of parameters a policy is.
    """

    law: FeedForward = field(kw_only=True)

    constant_feature: ClassVar[float] = 1.0

    @property
    def constants(self) -> int:
        return self.horizon

    def theta(self, policy: Array) -> Array:
        parts = self.law.parts(np.ravel(policy))
        return np.hstack([parts["K"], parts["b"].T])

    def policy(self, theta: Array, near: Array) -> Array:
        n_s = self.U.shape[1]
        parts = {"K": theta[:, :n_s], "b": theta[:, n_s:].T}
        return self.law.vector(parts).reshape(near.shape)

    def moment(self, simulation: Simulation, weights: Array) -> Array:
        """F, with a number that is 1 at a step and else 0 for each step."""
        features, n_s, T = simulation.features, self.U.shape[1], self.horizon
        found = np.zeros((n_s + T, n_s + T))
        found[:n_s, :n_s] = super().moment(simulation, weights)[:n_s, :n_s]
        found[:n_s, n_s:] = np.einsum("kfi,f->ik", features[:, :, :n_s], weights) / T
        found[n_s:, :n_s] = found[:n_s, n_s:].T
        found[n_s:, n_s:] = np.eye(T) / T
        return found
