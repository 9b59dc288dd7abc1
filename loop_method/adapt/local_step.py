# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A damped Gauss-Newton step on the local models that best predict differences of trajectories.

It always applies; the other kinds of proposals are tried first.

A model that follows one trajectory well can still be wrong about its neighbours, and a step needs
the neighbours. So a model is judged by what it will be used for: given the measured difference of
the initial fields, or the known difference of two policies, predict the difference of two measured
trajectories,

    delta_{k+1} = gamma ((A_k + B [K 0]) delta_k + B (theta_2 - theta_1) phi(s_k)),

with the law's features phi(s) = [s; 1, ...], and compare:
E = mean over pairs of min(2, sum_k |error_k|^2 / sum_k |delta_k|^2). No prediction at all has E = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.closed_loop import ClosedLoopProblem
from loop_method.adapt.local_model import LocalModel, extended_basis, fit
from loop_method.adapt.proposal import Proposal
from loop_method.adapt.sensitivity import ReducedTrajectory, damped_step
from loop_method.adapt.settings import GaussNewtonSettings

DEFAULTS = GaussNewtonSettings()


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two measured trajectories, and by how much theta differs, (n_a, n_s + 1)."""

    first: ReducedTrajectory
    second: ReducedTrajectory
    change: Array


def propose(
    loop: ClosedLoopProblem,
    data: Sequence[Record],
    shares: Sequence[float],
    incumbents: Sequence[Record],
    compared: Sequence[Record | None],
    *,
    damping: float,
    accepted: bool,
    settings: GaussNewtonSettings = DEFAULTS,
) -> Proposal | None:
    """The first step that gains enough, else the one that gains most, or None if none is finite.

    Parameters
    ----------
    loop : ClosedLoopProblem
        The closed loop and its cost.
    data : sequence of Record
        The rollouts that the models are fitted to.
    shares : sequence of float
        How much each of them counts.
    incumbents, compared, damping, accepted
        As for `Proposer.propose`.
    settings : GaussNewtonSettings
        Constants.
    """
    V = extended_basis(
        loop.U, [record.states for record in data], max(settings.modes, loop.U.shape[1])
    )
    models = _fit(data, shares, V, len(incumbents), settings)
    pairs = _comparisons(loop, V, incumbents, compared, settings.local_cost)
    errors = mismatches(models, pairs, loop.horizon, settings)
    paths = [path_of(loop, record, V) for record in incumbents if len(record.actions)]
    policy, least = incumbents[0].policy, settings.least_fall * loop.mean_cost_of(incumbents)
    proposal = None
    for kappa, chosen in choices(errors, accepted, settings):
        step, fall = damped_step(
            [models[i] for i in chosen],
            paths,
            target=V.T @ loop.target,
            state_weight=loop.state_weight,
            action_weight=loop.action_weight,
            gamma=float(np.exp(-kappa / loop.horizon)),
            damping=damping,
            isotropy=settings.isotropy,
        )
        candidate = loop.moved(policy, step)
        if not (np.isfinite(candidate).all() and np.isfinite(fall)):
            continue
        if proposal is None or fall > proposal.fall:
            error = float(errors[chosen, settings.forgettings.index(kappa)].min())
            proposal = Proposal(candidate, fall, len(chosen), kappa, error)
        if fall >= least:
            break
    return proposal


def _fit(
    data: Sequence[Record],
    shares: Sequence[float],
    V: Array,
    fields: int,
    settings: GaussNewtonSettings,
) -> list[LocalModel]:
    """The local models on V; after this many rollouts, a rollout ages by one."""
    newest = max(record.stamp for record in data)
    ages = [(newest - record.stamp) // fields for record in data]
    young = [max(settings.ageing**age, settings.least_weight) for age in ages]
    weights = [own * share for own, share in zip(young, shares, strict=True)]
    x, a, after, weight = steps_of(data, weights, V)
    return fit(
        x,
        a,
        after - x,
        weight,
        settings.ridge_values,
        leading=min(settings.cubic_modes, V.shape[1]),
        linear_ridge=settings.linear_ridge,
        action_ridge=settings.action_ridge,
    )


def steps_of(
    data: Sequence[Record], weights: Sequence[float], V: Array
) -> tuple[Array, Array, Array, Array]:
    """V^T z, a and V^T z after of all steps, and the weights of their rollouts."""
    parts = []
    for record, weight in zip(data, weights, strict=True):
        x = record.states @ V
        n = min(len(record.actions), len(x) - 1)
        parts.append((x[:n], record.actions[:n], x[1 : n + 1], np.full(n, weight)))
    before, a, after, every = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return before, a, after, every


def _comparisons(
    loop: ClosedLoopProblem,
    V: Array,
    incumbents: Sequence[Record],
    compared: Sequence[Record | None],
    local: float,
) -> list[Comparison]:
    """Pairs of whole rollouts: two fields, and two policies on one field."""
    chosen = []
    for i, record in enumerate(incumbents):
        neighbour, other = incumbents[(i + 1) % len(incumbents)], compared[i]
        if neighbour is not record and neighbour.usable and record.usable:
            chosen.append((record, neighbour))
        if other is not None and record.usable and other.cost < local * record.cost:
            chosen.append((record, other))
    return [
        Comparison(
            path_of(loop, first, V),
            path_of(loop, second, V),
            loop.theta(second.policy) - loop.theta(first.policy),
        )
        for first, second in chosen
    ]


def path_of(loop: ClosedLoopProblem, record: Record, V: Array) -> ReducedTrajectory:
    """A measured rollout in the coordinates x = V^T z, of which s are the first."""
    K = np.ascontiguousarray(record.policy[:, : loop.U.shape[1]])
    x = record.acted_from @ V
    features = np.hstack([x[:, : K.shape[1]], np.full((len(x), 1), loop.constant_feature)])
    free = None
    if loop.action_set.bounded:
        free = loop.action_set.inside(record.actions).astype(np.float64)
    return ReducedTrajectory(x, record.actions, features, K, free)


def mismatches(
    models: Sequence[LocalModel],
    pairs: Sequence[Comparison],
    horizon: int,
    settings: GaussNewtonSettings = DEFAULTS,
) -> Array:
    """E of every model and kappa, (models, kappas); zeros without pairs."""
    kappas, worst = settings.forgettings, settings.worst
    errors = np.zeros((len(models), len(kappas)))
    if not pairs:
        return errors
    x = np.stack([pair.first.x for pair in pairs])
    measured = np.stack([pair.second.x for pair in pairs]) - x
    forcing = np.stack([pair.second.features @ pair.change.T for pair in pairs])
    size = np.maximum(np.sum(measured**2, axis=(1, 2)), 1e-300)
    free = None
    if pairs[0].first.free is not None:
        free = np.stack([pair.first.free for pair in pairs if pair.first.free is not None])
    gammas = np.exp(-np.array(kappas) / horizon)
    for i, model in enumerate(models):
        # A model that is unstable along the trajectory overflows: it counts as the worst.
        with np.errstate(over="ignore", invalid="ignore"):
            predicted = predict_difference(
                model.jacobians(x),
                model.B,
                pairs[0].first.K,
                initial=measured[:, 0],
                forcing=forcing,
                gammas=gammas,
                free=free,
            )
            error = np.sum((predicted - measured) ** 2, axis=(2, 3)) / size
        error = np.where(np.isfinite(error), np.minimum(error, worst), worst)
        errors[i] = error.mean(axis=1)
    return errors


def choices(
    errors: Array, accepted: bool, settings: GaussNewtonSettings = DEFAULTS
) -> list[tuple[float, list[int]]]:
    """Forgetting, and the models to average over with it; the choice to use first comes first.

    Parameters
    ----------
    errors : (models, kappas) array
        From `mismatches`.
    accepted : bool
        Whether the last candidate was accepted: if so little forgetting is preferred, as it sees
        the whole effect of a step, and otherwise the smallest error.
    settings : GaussNewtonSettings
        Constants.
    """
    kappas, margin = settings.forgettings, settings.alike_margin
    best = errors.min(axis=0)
    order = [int(j) for j in np.argsort(best, kind="stable")]
    if accepted:
        first = int(np.argmax(best <= settings.enough_factor * best.min() + margin))
        order = [first, *(j for j in order if j != first)]
    alike = np.minimum(settings.alike_factor * best + margin, best + settings.alike_distance)
    return [(kappas[j], [int(i) for i in np.flatnonzero(errors[:, j] <= alike[j])]) for j in order]


def predict_difference(
    jacobians: Array,
    B: Array,
    K: Array,
    *,
    initial: Array,
    forcing: Array,
    gammas: Array,
    free: Array | None = None,
) -> Array:
    """Predict the difference of a second trajectory from a measured one, to first order.

        delta_{k+1} = gamma ((A_k + B [K 0]) delta_k + B f_k)

    Parameters
    ----------
    jacobians : (P, T, r, r) array
        A_k along the measured trajectories of P pairs.
    B : (r, n_a) array
        Input matrix of the model.
    K : (n_a, n_s) array
        Feedback of the first trajectory of every pair: one policy, the incumbent's.
    initial : (P, r) array
        delta_0.
    forcing : (P, T, n_a) array
        f_k = (theta_2 - theta_1) phi(s_k) along the second trajectory.
    gammas : (C,) array
        Values of gamma.
    free : (P, T, n_a) array, optional
        Of the measured trajectories, see `ReducedTrajectory`.

    Returns
    -------
    (C, P, T, r) array
        delta_0 .. delta_{T-1} for every gamma.
    """
    pairs, steps, r, _ = jacobians.shape
    n_s = K.shape[-1]
    closed = jacobians.copy()
    if free is None:
        closed[..., :n_s] += B @ K
        drive = forcing @ B.T
    else:
        closed[..., :n_s] += (B * free[..., None, :]) @ K
        drive = (forcing * free) @ B.T
    # Steps first and gammas last: every step is one product of matrices, of memory that lies together.
    closed = np.ascontiguousarray(closed.swapaxes(0, 1))
    difference = np.empty((steps, pairs, r, gammas.size))
    difference[0] = initial[..., None]
    for k in range(steps - 1):
        np.matmul(closed[k], difference[k], out=difference[k + 1])
        difference[k + 1] += drive[:, k, :, None]
        difference[k + 1] *= gammas
    return np.ascontiguousarray(difference.transpose(3, 1, 0, 2))
