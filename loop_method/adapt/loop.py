# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The closed loop of measured rollouts: what a law costs, and its path in a few coordinates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.sensitivity import ReducedTrajectory


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
    """

    U: Array
    target: Array
    state_weight: float
    action_weight: float
    horizon: int
    action_limit: float

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
