# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Improve a law on a model that reproduces the measured rollouts.

With a model of the whole field (`loop_method.field_models`) the closed loop can be simulated from
every initial field that was measured, and the Gauss-Newton step repeated on the simulated trajectories
until it gains nothing more:

    theta = argmin  mean over fields of J_model(theta) + lambda r tr(d F d^T),    d = theta - theta_0,

where theta_0 is the incumbent and F = mean phi phi^T with the isotropic part of
`sensitivity.damped_step`: the same trust region in input energy, so that lambda means the same. Only
the result is rolled out on the plant, which judges it.

References
----------
Levenberg, Quart. Appl. Math. 2, 1944; Marquardt, J. SIAM 11, 1963 (the damping of the inner steps).
Parikh, Boyd, "Proximal algorithms", Foundations and Trends in Optimization 1, 2014 (the outer one).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.sensitivity import ISOTROPY, ReducedTrajectory, expand
from loop_method.field_models import FieldModel
from loop_method.field_models.differential import DifferentialModel

# Inner steps, and the share of the objective below which a further one is not worth its time: in few
# coordinates the gradient is no better, while the adjoint one leads on where steps are small.
_STEPS = 10
_LEAST_GAIN, _LEAST_GAIN_ADJOINT = 1e-3, 1e-4
# Damping of the inner steps: first, factor after a fall and after a rise, largest.
_INNER = (1.0, 0.1, 10.0, 1e4)
_WORST = 2.0


@dataclass(frozen=True, eq=False)
class Loop:
    """The closed loop of a law a = K U^T z + b, and its cost.

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
        0: none.
    noise : float
        Standard deviation of what a simulation adds to U^T z; 0: nothing.
    """

    U: Array
    target: Array
    state_weight: float
    action_weight: float
    horizon: int
    action_limit: float
    noise: float = 0.0

    @cached_property
    def s_r(self) -> Array:
        """U^T z_r, (n_s,), as a plain sum like the controller's."""
        projected: Array = np.sum(self.U * self.target[:, None], axis=0)
        return projected

    @cached_property
    def one(self) -> float:
        """0 where the target is outside of U, so that the law has no constant part b, else 1."""
        inside = float(np.sum(self.s_r * self.s_r))
        return 1.0 if inside > 1e-20 * float(np.sum(self.target * self.target)) else 0.0

    def theta(self, policy: Array) -> Array:
        """[K_a b] of a policy [K_a K_b], (n_a, n_s + 1)."""
        n_s = self.U.shape[1]
        return np.column_stack([policy[:, :n_s], policy[:, n_s:] @ self.s_r])

    def moved(self, policy: Array, step: Array) -> Array:
        """The policy after a step of theta; K_b moves least among those with the wanted b."""
        n_s, moved = self.U.shape[1], policy.copy()
        moved[:, :n_s] += step[:, :n_s]
        if self.one:
            moved[:, n_s:] += np.outer(step[:, n_s], self.s_r / float(np.sum(self.s_r * self.s_r)))
        return moved

    def noise_of(self, count: int) -> Array:
        """Noise added to U^T z of `count` fields, (T, count, n_s); the same for every law."""
        size = self.horizon, count, self.U.shape[1]
        return self.noise * np.random.default_rng(0).standard_normal(size)

    def simulate(self, model: FieldModel, theta: Array, fields: Array) -> Simulation:
        """Roll theta = [K b] (n_a, n_s + 1) out on the model from the fields (F, n_z)."""
        K, b = theta[:, :-1], self.one * theta[:, -1]
        z = np.empty((self.horizon + 1, *fields.shape))
        a = np.empty((self.horizon, len(fields), len(theta)))
        z[0] = fields
        noise = self.noise_of(len(fields)) if self.noise else None
        # A law or a model that is unstable overflows: its cost is then not finite.
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self.horizon):
                s = z[k] @ self.U
                if noise is not None:
                    s += noise[k]
                a[k] = s @ K.T + b
                if self.action_limit:
                    np.clip(a[k], -self.action_limit, self.action_limit, out=a[k])
                z[k + 1] = model.step(z[k], a[k])
            return Simulation(z[:-1], a, self.mean_cost(z[:-1], a))

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

    def measured(self, record: Record) -> tuple[Array, Array]:
        """theta, and the states from which it acted."""
        return self.theta(record.policy), record.acted_from

    def path_of(self, record: Record, V: Array) -> ReducedTrajectory:
        """A measured rollout in the coordinates x = V^T z."""
        K = np.ascontiguousarray(record.policy[:, : self.U.shape[1]])
        return self.path(record.acted_from, record.actions, K, V)

    def path(self, states: Array, actions: Array, K: Array, V: Array) -> ReducedTrajectory:
        """A trajectory under the feedback K in the coordinates x = V^T z, of which s are the first."""
        x = states @ V
        features = np.hstack([x[:, : K.shape[1]], np.full((len(x), 1), self.one)])
        free = None
        if self.action_limit:
            free = (np.abs(actions) < self.action_limit).astype(np.float64)
        return ReducedTrajectory(x, actions, features, K, free)


@dataclass(frozen=True, eq=False)
class Simulation:
    """States (T, F, n_z), actions (T, F, n_a), and the mean stage cost over steps and fields."""

    states: Array
    actions: Array
    cost: float


@dataclass(frozen=True, eq=False)
class Improvement:
    """A law [K b], by how much its cost is lower on the model, and the laws on the way, it the last."""

    theta: Array
    fall: float
    path: Sequence[Array]


def mismatch(
    loop: Loop,
    model: FieldModel,
    measured: Sequence[tuple[Array, Array]],
    most: float,
) -> float:
    """How far simulated rollouts are from the measured ones.

        E = mean over rollouts of min(2, sum_k |z_k^model - z_k|^2 / sum_k |z_k - z_r|^2)

    measured: (theta, states (T, n_z)) of every rollout. Once E is known to be above `most`, the other
    rollouts are left out, and what is returned is a lower bound of E.
    """
    errors: list[float] = []
    for theta, states in measured:
        simulated = loop.simulate(model, theta, states[:1]).states[: len(states), 0]
        with np.errstate(over="ignore", invalid="ignore"):
            error = float(np.sum((simulated - states) ** 2))
        size = max(float(np.sum((states - loop.target) ** 2)), 1e-300)
        errors.append(min(_WORST, error / size) if np.isfinite(error) else _WORST)
        if sum(errors) > most * len(measured):
            return sum(errors) / len(measured)
    return float(np.mean(errors))


def mismatch_of_pieces(
    loop: Loop, model: FieldModel, measured: Sequence[tuple[Array, Array]], length: int
) -> float:
    """How far rollouts, restarted at regular intervals, are from the measured ones.

        sum |z_k^model - z_k|^2 / sum |z_k - z_r|^2

    A chaotic plant forgets where it began, so that no model reproduces a whole rollout.
    """
    short = replace(loop, horizon=length)
    error = size = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        for theta, states in measured:
            starts = np.arange(0, len(states) - length + 1, length)
            simulated = short.simulate(model, theta, states[starts]).states
            pieces = states[starts + np.arange(length)[:, None]]
            error += float(np.sum((simulated - pieces) ** 2))
            size += float(np.sum((pieces - loop.target) ** 2))
    return error / max(size, 1e-300) if np.isfinite(error) else np.inf


def improve(
    loop: Loop,
    model: FieldModel,
    theta: Array,
    fields: Array,
    V: Array,
    damping: float,
) -> Improvement:
    """Gauss-Newton steps on the model until they gain nothing more.

    Parameters
    ----------
    loop : Loop
        The law's basis, the target and the weights.
    model : FieldModel
        One that reproduces the measured rollouts.
    theta : (n_a, n_s + 1) array
        Where to start, and what the trust region is about.
    fields : (F, n_z) array
        Initial fields.
    V : (n_z, r) array
        Orthonormal coordinates of the sensitivities, U first.
    damping : float
        lambda.
    """
    start, shape, path = theta, theta.shape, [theta]
    now = first = loop.simulate(model, theta, fields)
    gradient, curvature, region = _expansion(loop, model, theta, now, V)
    trust = region.copy()
    inner, fewer, more, most = _INNER

    def objective(simulation: Simulation, at: Array) -> float:
        moved = at - start
        return simulation.cost + damping * float(np.sum((moved @ trust) * moved))

    value = objective(now, theta)
    least = _LEAST_GAIN_ADJOINT if isinstance(model, DifferentialModel) else _LEAST_GAIN
    for _ in range(_STEPS):
        pull = 2.0 * damping * ((theta - start) @ trust)
        matrix = curvature + 2.0 * np.kron(np.eye(len(theta)), inner * region + damping * trust)
        matrix[np.diag_indices(len(matrix))] += 1e-9 * np.trace(curvature) / len(matrix)
        if not (np.isfinite(matrix).all() and np.isfinite(gradient).all()):
            break
        step = linalg.cho_solve(linalg.cho_factor(matrix), -(gradient + pull.reshape(-1)))
        candidate = theta + step.reshape(shape)
        simulation = loop.simulate(model, candidate, fields)
        lower = objective(simulation, candidate)
        if not lower < value:  # also where it is not finite
            inner *= more
            if inner > most:
                break
            continue
        gain, value = value - lower, lower
        theta, now = candidate, simulation
        path.append(theta)
        inner *= fewer
        if gain < least * value:
            break
        gradient, curvature, region = _expansion(loop, model, theta, now, V)
    return Improvement(theta, first.cost - now.cost, path)


def _expansion(
    loop: Loop, model: FieldModel, theta: Array, simulation: Simulation, V: Array
) -> tuple[Array, Array, Array]:
    """Gradient, Gauss-Newton curvature, and r (F + isotropic part), averaged over the fields.

    The curvature and, but for a differential model, the gradient are those in the coordinates V.
    """
    n_f = theta.shape[1]
    count = simulation.states.shape[1]
    gradient, curvature = np.zeros(theta.size), np.zeros((theta.size, theta.size))
    energy = np.zeros((n_f, n_f))
    B = V.T @ model.B
    noise = loop.noise_of(count) if loop.noise else None
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(count):
            states = simulation.states[:, i]
            path = loop.path(states, simulation.actions[:, i], theta[:, :-1], V)
            if noise is not None:
                path.features[:, :-1] += noise[:, i]
            expansion = expand(
                path,
                model.jacobians(states, V),
                B,
                target=V.T @ loop.target,
                state_weight=loop.state_weight,
                action_weight=loop.action_weight,
                gamma=1.0,
            )
            gradient += expansion.gradient / count
            curvature += expansion.curvature / count
            energy += path.features.T @ path.features / (len(path.features) * count)
        if isinstance(model, DifferentialModel):
            gradient = adjoint_gradient(loop, model, theta, simulation)
    energy[np.diag_indices(n_f)] += ISOTROPY * np.trace(energy) / n_f
    return gradient, curvature, loop.action_weight * energy


def adjoint_gradient(
    loop: Loop, model: DifferentialModel, theta: Array, simulation: Simulation
) -> Array:
    """The gradient of the simulated cost in theta, in all coordinates.

    With g_k the derivative of T J in a_k, and p_k that in z_k, p_T = 0,

        g_k = 2 r a_k + (d step / da)^T p_{k+1},
        p_k = 2 q (z_k - z_r) + (d step / dz)^T p_{k+1} + U K^T g_k.

    Near the optimum of a loop with steep fronts the one in fewer coordinates no longer descends.
    """
    K, (horizon, count) = theta[:, :-1], simulation.states.shape[:2]
    noise = loop.noise_of(count)
    gradient, p = np.zeros_like(theta), np.zeros_like(simulation.states[0])
    for k in reversed(range(horizon)):
        z, a = simulation.states[k], simulation.actions[k]
        through, g = model.transposed(z, a, p)
        g = g + 2.0 * loop.action_weight * a
        if loop.action_limit:
            g = g * (np.abs(a) < loop.action_limit)
        gradient[:, :-1] += g.T @ (z @ loop.U + noise[k])
        gradient[:, -1] += loop.one * g.sum(axis=0)
        p = 2.0 * loop.state_weight * (z - loop.target) + through + g @ K @ loop.U.T
    mean: Array = gradient.reshape(-1) / (horizon * count)
    return mean
