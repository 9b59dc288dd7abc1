# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`NavierStokes` of PDEControlGym: a flow under a lid that is to follow another one."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

import pdeloop
from benchmarks.tasks.common import Row, name_of, shown, trained
from pde_sim_node.plants import DynamicsPlant
from pde_sim_node.plants.cavity import Cavity
from pdeloop.episode import Law
from pdeloop.messages.arrays import Array

ORDER = 8


def rows(budgets: list[int], seeds: int) -> Iterator[Row]:
    plant = DynamicsPlant(Cavity())

    def row(name: str, value: Any, episodes: Any, by: str = "here") -> Row:
        return {"controller": name, "return": value, "episodes": episodes, "by": by}

    def returned(law: Law) -> float:
        return -float(pdeloop.rollout(plant, law, [0], keep=False).costs.total[0])

    yield row("SAC", "-17.8", 1005, "PDEControlGym")
    yield row("PPO", "about -5.4", 1005, "PDEControlGym")
    for a in (1.0, 2.0, 2.5, 3.0):
        held = np.full((1, 1), a)
        yield row(f"constant lid {a:g}", shown(returned(partial(_constant, held))), 0)
    once, twice = [], []
    for seed in range(seeds):
        explored = pdeloop.problem(plant=Cavity(), exploration_variance=1.0).explore(seed)
        first = _tracking(plant, explored)
        found = pdeloop.rollout(plant, first, [0])
        once.append(-found.costs.total[0])
        twice.append(
            returned(_tracking(plant, explored, (found.states[:, 0], found.actions[:, 0])))
        )
    yield row(f"LQ tracking over the horizon, order {ORDER}", shown(once, np.min), 1)
    yield row("the same, identified again", shown(twice, np.min), 2)
    for budget in budgets:
        how = {"reduced_order": ORDER, "exploration_variance": 1.0}
        laws = [trained(Cavity, seed, budget, **how) for seed in range(seeds)]
        found_returns = [returned(law) for law, _ in laws]
        spent = max(count for _, count in laws)
        name = "the first law, affine" if budget == 1 else f"{name_of(budget)}, affine law"
        yield row(name, shown(found_returns, np.min), spent)
    yield row("the best known 199 inputs", f"{-_least(plant):.7g}", "")


def _constant(action: Array, k: int, z: Array) -> Array:
    """The same action at each step."""
    return action


def _tracking(plant: DynamicsPlant, *trajectories: tuple[Array, Array]) -> Law:
    """LQ tracking with a reduced model of some trajectories."""
    model = pdeloop.identify(*trajectories, n_s=ORDER, constant=None)
    K, b = pdeloop.track_horizon(model.A, model.B, plant.cost, model.U)
    return lambda k, z: (z @ model.U) @ K[k].T + b[k]


def _least(plant: DynamicsPlant) -> float:
    """The least cost of any inputs, by Gauss-Newton steps with differences."""
    T, cost, step = plant.horizon, plant.cost, 1e-3
    a_r, r = float(cost.action_target[0]), float(cost.action_weight)
    actions = np.full(T, a_r)
    for _ in range(3):
        tried = np.vstack([actions, actions + step * np.eye(T)])
        law = lambda k, z, tried=tried: tried[:, k : k + 1]  # noqa: E731
        states = pdeloop.rollout(plant, law, np.zeros(T + 1, int)).states
        change = np.sqrt(cost.state_weight) * (states[:, 1:] - states[:, :1]) / step
        error = np.sqrt(cost.state_weight) * (states[:, 0] - cost.target)
        J = np.vstack([change.transpose(0, 2, 1).reshape(-1, T), np.sqrt(r) * np.eye(T)])
        residual = np.concatenate([error.ravel(), np.sqrt(r) * (actions - a_r)])
        actions = actions - np.linalg.solve(J.T @ J, J.T @ residual)
    best = pdeloop.rollout(plant, lambda k, z: actions[k].reshape(1, 1), [0], keep=False)
    return float(best.costs.total[0])
