# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A linear or slightly bent plant in a higher dimension, and Gauss-Newton on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from loop_method.adapt import Context, GaussNewton, Rollout, RolloutResult, Trajectory
from loop_method.design.lqt import track
from loop_method.reduce.reduced_model import ReducedModel
from tests.support.small import same_bits

N_Z, N_S, N_A, T = 7, 4, 2, 80
Q, R = 1.0, 0.2


class Plant:
    """s' = A s + B a, lifted to N_Z dimensions; `bend` adds a quadratic term."""

    def __init__(self, bend: float = 0.0) -> None:
        rng = np.random.default_rng(0)
        A = rng.standard_normal((N_S, N_S))
        self.A = 1.02 * A / np.abs(np.linalg.eigvals(A)).max()
        self.B = rng.standard_normal((N_S, N_A))
        self.U = np.linalg.qr(rng.standard_normal((N_Z, N_S)))[0]
        self.target = self.U @ np.array([0.5, -0.2, 0.3, 0.1])
        self.bend = bend
        self.model = ReducedModel(A=self.A, B=self.B, U=self.U)
        self.best = track(self.model, state_weight=Q, action_weight=R).policy

    def run(self, policy: np.ndarray, seed: int, noise: np.ndarray | None = None) -> RolloutResult:
        s = np.random.default_rng(seed).standard_normal(N_S)
        b = policy[:, N_S:] @ self.U.T @ self.target
        states, actions, cost = [self.U @ s], [], 0.0
        for k in range(T):
            a = policy[:, :N_S] @ s + b if noise is None else noise[k]
            cost += Q * float(np.sum((states[-1] - self.target) ** 2)) + R * float(a @ a)
            s = self.A @ s + self.B @ a + self.bend * np.tanh(s) * s[::-1]
            actions.append(a)
            if np.abs(s).max() > 1e3:
                done = Trajectory(np.array(states), np.array(actions)[:-1])
                return RolloutResult(1e9, True, done)
            states.append(self.U @ s)
        return RolloutResult(cost / T, False, Trajectory(np.array(states), np.array(actions)))

    def context(self) -> Context:
        noise = 0.3 * np.random.default_rng(1).standard_normal((T, N_A))
        exploration = self.run(np.zeros((N_A, 2 * N_S)), 77, noise).trajectory
        assert exploration is not None
        # No field on an axis, of which many models would be tried.
        return Context(self.U, self.target, Q, R, T, exploration, periodic=False, line=False)


def make(plant: Plant, policy: np.ndarray | None = None, **changes: Any) -> GaussNewton:
    settings: dict[str, Any] = {"seed": 5, "rollouts": 24, "context": plant.context()}
    return GaussNewton(0.6 * plant.best if policy is None else policy, **(settings | changes))


def measure(plant: Plant, asked: list[Rollout]) -> list[RolloutResult]:
    return [plant.run(rollout.policy, rollout.field_seed) for rollout in asked]


def mean_cost(plant: Plant, policy: np.ndarray) -> float:
    return float(np.mean([plant.run(policy, 10**6 + i).cost for i in range(40)]))


def same_state(a: GaussNewton, b: GaussNewton) -> bool:
    one, other = a.state(), b.state()
    return one.keys() == other.keys() and all(same_bits(one[k], other[k]) for k in one)
