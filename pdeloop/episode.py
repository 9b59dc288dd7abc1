# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An episode of a plant under a law, in this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller_node.policy import ProjectedLaw
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plant import EpisodeCosts, Plant
from pde_sim_node.plants.loading import as_plant
from pdeloop.messages.action_set import ANY_ACTION
from pdeloop.messages.arrays import Array, float_array
from pdeloop.method.design.lqt import Gains

__all__ = ["EpisodeRecord", "Law", "finite_array", "projected_law", "rollout"]

Law: TypeAlias = Callable[[int, Array], Array]
"""(k, z_k of shape (M, state_size)) -> a_k of shape (M, n_a)."""


@dataclass(frozen=True, eq=False)
class EpisodeRecord:
    """The record of an episode of T steps of M environments.

    Attributes
    ----------
    states : (T + 1, M, state_size) array
        z_0 .. z_T as the plant publishes them: its fields, or what its sensors measure of them. An
        environment that diverged keeps its last state. Without `keep` there are none, (0, M, ...).
    fields : (T + 1, M, n_z) array
        The fields themselves; the same array where they are what is published.
    actions : (T, M, n_a) array
        a_0 .. a_{T-1}, as the law gave them.
    costs : EpisodeCosts
        Mean and sum of the stage costs, and where an environment diverged.
    applied : (T, M, n_a) array
        The actions that the actuators applied for these, within their bounds.
    stage_costs : (T, M) array or None
        l_0 .. l_{T-1}; None where only their sum is known.
    seeds : (M,) int array or None
        Seeds of the initial fields, -1 for the mean field; None where the fields were given.
    """

    states: Array
    fields: Array
    actions: Array
    costs: EpisodeCosts
    applied: Array
    stage_costs: Array | None = None
    seeds: NDArray[np.int64] | None = None

    def __repr__(self) -> str:
        steps, cost = len(self.actions), self.costs.mean
        return (
            f"EpisodeRecord({steps} steps of {len(cost)} environments, mean cost {cost.mean():.4g})"
        )

    @property
    def whole(self) -> bool:
        """True if no environment diverged."""
        return bool((self.costs.diverged_step < 0).all())


def rollout(
    plant: Plant | Dynamics,
    law: Law,
    seeds: ArrayLike,
    noise: NDArray[np.int64] | None = None,
    *,
    keep: bool = True,
) -> EpisodeRecord:
    """Run one episode, z_{k+1} = f(z_k, law(k, z_k)) for k = 0 .. T - 1.

    Parameters
    ----------
    plant
        The plant, whose current episode ends; or a `Dynamics`, from which a plant is made.
    law
        Called once per step, in order, with the plant's own array, which it must not change.
    seeds : (M,) int, or (M, n_z)
        Seeds of the initial fields (-1: the mean field), or the fields themselves.
    noise : (M,) int, optional
        Seeds of the noise of each environment, if the plant has noise.
    keep
        Whether to keep states and actions; costs are always kept.

    Returns
    -------
    EpisodeRecord

    Raises
    ------
    ValueError
        There is no plant, law or seed, or the law returns actions of another shape or that are
        not finite.

    Examples
    --------
    >>> import numpy as np
    >>> import pdeloop
    >>> plant = pdeloop.problem("burgers").plant()
    >>> episode = pdeloop.rollout(plant, lambda k, z: np.zeros((2, plant.n_a)), [0, 1])
    >>> episode.states.shape, episode.actions.shape
    ((301, 2, 128), (300, 2, 6))
    >>> (episode.costs.diverged_step < 0).all()
    np.True_
    """
    plant = as_plant(plant)
    if not callable(law):
        raise ValueError(f"law is {law!r}; expected a function of k and the states")
    if noise is not None:
        given = np.asarray(noise)
        if given.dtype.kind not in "iu" or given.shape != np.shape(seeds)[:1]:
            raise ValueError(
                f"noise is {noise!r}; expected {len(np.atleast_1d(seeds))} whole numbers, a seed for "
                "each environment"
            )
    z = plant.reset(seeds, noise)
    batch, kept = len(z), plant.horizon if keep else -1
    states = np.empty((kept + 1, *z.shape))
    actions = np.empty((max(kept, 0), batch, plant.n_a))
    applied, stage_costs = actions.copy(), np.empty(actions.shape[:2])
    own = not plant.instruments.ideal
    fields = np.empty((kept + 1, batch, plant.n_z)) if own else states
    for k in range(plant.horizon + 1):
        if keep:
            states[k] = z
            if own:
                fields[k] = plant.states
        if k < plant.horizon:
            a = law(k, z)
            before = plant.totals.copy()
            z = plant.step(a)
            if keep:
                actions[k], applied[k], stage_costs[k] = a, plant.actions, plant.totals - before
    drawn = np.asarray(seeds, dtype=np.int64) if np.ndim(seeds) == 1 else None
    return EpisodeRecord(
        states, fields, actions, plant.episode_costs(), applied, stage_costs, drawn
    )


def projected_law(plant: Plant, U: ArrayLike, policy: ArrayLike | Gains) -> Law:
    """The law a = K_a U^T z + K_b U^T z_r, saturated where the plant's actions are.

    Parameters
    ----------
    plant
        The plant, for its target z_r and action limit.
    U : (state_size, n_s)
        Basis of the reduced state, that of a reduced model.
    policy : (n_a, 2 n_s), or (M, n_a, 2 n_s)
        [K_a K_b], one for all environments or one for each of M; or the `Gains` of `pdeloop.track`,
        whose constant part b is then in K_b U^T z_r.

    Returns
    -------
    Law

    Raises
    ------
    ValueError
        Shapes that do not fit the plant, NaN or infinity, or a constant part with a target of 0.

    See Also
    --------
    controller_node.policy.ProjectedLaw : the same to the bit, with a model for each environment.

    Examples
    --------
    >>> import pdeloop
    >>> problem = pdeloop.problem("burgers")
    >>> plant = problem.plant()
    >>> model = pdeloop.identify(problem.explore(0), n_s=4, constant=None)  # as in a training
    >>> gains = pdeloop.track(model, state_weight=1.0, action_weight=1.0)
    >>> law = pdeloop.projected_law(plant, model.U, gains)
    >>> pdeloop.rollout(plant, law, [0, 1, 2]).costs.mean.round(1)
    array([0.6, 0.7, 0.6])
    """
    basis = finite_basis(plant, U)
    if isinstance(policy, Gains):
        policy = policy.policy_for(basis.T @ plant.target)
    gains = float_array("policy", policy)
    gains = finite_array("policy", gains, (*gains.shape[:-2], plant.n_a, 2 * basis.shape[1]))
    allowed, batch = plant.action_set, 0
    projected = ProjectedLaw([basis], plant.target, ANY_ACTION if allowed.rated else allowed)
    before = allowed.start

    def actions(k: int, states: Array) -> Array:
        nonlocal batch, before
        if batch != len(states):
            batch = len(states)
            projected.set(np.broadcast_to(gains, (batch, *gains.shape[-2:])))
        found = projected.actions(states)
        if allowed.rated:
            before = found = allowed.project(found, after=before if k else allowed.start)
        return found

    return actions


def finite_basis(plant: Plant, U: ArrayLike) -> Array:
    """A basis (state_size, n_s) of the plant's states; a ValueError unless it is one, and finite."""
    basis = float_array("U", U)
    if basis.ndim != 2 or len(basis) != plant.state_size:
        raise ValueError(f"U must have shape ({plant.state_size}, n_s), got {basis.shape}")
    return finite_array("U", basis, basis.shape)


def finite_array(name: str, values: ArrayLike, shape: Sequence[int]) -> Array:
    """The values as float64; a ValueError unless they are finite and of this shape."""
    array = float_array(name, values)
    if array.shape != tuple(shape):
        raise ValueError(f"{name} must have shape {tuple(shape)}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got NaN or infinity")
    return array
