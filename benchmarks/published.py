# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks published TASK`: tasks with published figures, side by side."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

import pdeloop
from benchmarks.backstepping import reaction_gain, transport_gain
from loop_interfaces.arrays import Array
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plants import DynamicsPlant
from pde_sim_node.plants.boundary import BoundaryControlled, ReactionDiffusionBoundary, Transport
from pde_sim_node.plants.cavity import Cavity
from pde_sim_node.plants.convection import Convection
from pdeloop.episode import EpisodeRecord, Law

__all__ = ["run", "text"]

Task = Literal["lid", "convection", "transport", "reaction-diffusion"]
Row = dict[str, Any]
PROBES = 16
"""Of the convection, 4 x 4."""
EXPLORED, HELD = 10, 8
"""Rollouts from rest with which the convection is explored, and their actions."""
QUIET = 1e-3
"""Standard deviation of these actions: so small that what they begin is still linear."""
ORDER = 8
LEAST = 6
"""Rollouts that a training takes as it is: two explorations, one of the first law and three that judge;
with fewer it judges by fewer."""
FIELDS = np.arange(2000, 2010)
"""Initial fields of the tasks in one dimension."""


def run(
    task: Task, *, rollouts: list[int] | None = None, cells: int = 50, seeds: int = 3
) -> list[Row]:
    """Measure controllers on a published task, and show the published figures beside them.

    Parameters
    ----------
    task
        The published task.
    rollouts
        Budgets of the trainings; 1: the first law, from one exploration. [1 5 20 80]
    cells
        Cells in each direction, for the convection.
    seeds
        Number of seeds of what is random; the worst seed is shown in brackets.
    """
    budgets = [1, 5, 20, 80] if rollouts is None else rollouts
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pdeloop.IdentifiabilityWarning)
        if task == "lid":
            return list(_lid(budgets, seeds))
        if task == "convection":
            return list(_convection(budgets, seeds, cells))
        kind = Transport if task == "transport" else ReactionDiffusionBoundary
        return list(_one_dimension(kind(), budgets, seeds))


def text(rows: list[Row]) -> str:
    """A table in Markdown."""
    names = list(rows[0])
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    lines += [f"| {' | '.join(str(row[name]) for name in names)} |" for row in rows]
    return "\n".join(lines)


def _shown(values: Any, worst: Callable[[Any], Any] = np.max) -> str:
    found = np.atleast_1d(values)
    extra = f" ({worst(found):.5g})" if len(found) > 1 else ""
    return f"{np.mean(found):.5g}{extra}"


def _trained(
    plant: Callable[[], Dynamics], seed: int, rollouts: int, **how: Any
) -> tuple[Law, int]:
    """The law of a training, and how many rollouts it took; of one, that of the exploration."""
    made = plant()
    if rollouts == 1:
        loop = DynamicsPlant(made)
        explored = pdeloop.problem(plant=made, **how).explore(seed)
        model = pdeloop.identify(explored, n_s=how["reduced_order"])
        weights = {name: getattr(loop, name) for name in ("state_weight", "action_weight")}
        gains = pdeloop.track(model, **weights, cost=loop.cost)
        return pdeloop.projected_law(loop, model.U, gains.policy), 1
    if rollouts < LEAST:
        how["optimizer_settings"] = {"judging": rollouts - LEAST + 3}
    how["rollouts"] = rollouts
    with tempfile.TemporaryDirectory() as folder:
        found = pdeloop.train(
            plant=made, seed=seed, evaluation_fields=1, out=Path(folder) / "run", **how
        )
        spent = sum(found.rollouts[0][part] for part in ("exploration", "check", "adaptation"))
    return pdeloop.projected_law(DynamicsPlant(made), found.models[0].U, found.policies[0]), spent


def _name(budget: int) -> str:
    return "the first law" if budget == 1 else "`pdeloop.train`"


# The lid


def _lid(budgets: list[int], seeds: int) -> Iterator[Row]:
    plant = DynamicsPlant(Cavity())

    def row(name: str, value: Any, episodes: Any, by: str = "here") -> Row:
        return {"controller": name, "return": value, "episodes": episodes, "by": by}

    def returned(law: Law) -> float:
        return -float(pdeloop.rollout(plant, law, [0], keep=False).costs.total[0])

    yield row("SAC", "-17.8", 1005, "PDEControlGym")
    yield row("PPO", "about -5.4", 1005, "PDEControlGym")
    for a in (1.0, 2.0, 2.5, 3.0):
        held = np.full((1, 1), a)
        yield row(f"constant lid {a:g}", _shown(returned(partial(_constant, held))), 0)
    once, twice = [], []
    for seed in range(seeds):
        explored = pdeloop.problem(plant=Cavity(), exploration_variance=1.0).explore(seed)
        first = _tracking(plant, explored)
        found = pdeloop.rollout(plant, first, [0])
        once.append(-found.costs.total[0])
        twice.append(
            returned(_tracking(plant, explored, (found.states[:, 0], found.actions[:, 0])))
        )
    yield row(f"LQ tracking over the horizon, order {ORDER}", _shown(once, np.min), 1)
    yield row("the same, identified again", _shown(twice, np.min), 2)
    for budget in budgets:
        how = {"reduced_order": ORDER, "exploration_variance": 1.0}
        laws = [_trained(Cavity, seed, budget, **how) for seed in range(seeds)]
        found_returns = [returned(law) for law, _ in laws]
        spent = max(count for _, count in laws)
        name = "the first law, affine" if budget == 1 else f"{_name(budget)}, affine law"
        yield row(name, _shown(found_returns, np.min), spent)
    yield row("limit: the best 199 inputs", f"{-_least(plant):.7g}", "")


def _constant(action: Array, k: int, z: Array) -> Array:
    """The same action at each step."""
    return action


def _tracking(plant: DynamicsPlant, *trajectories: tuple[Array, Array]) -> Law:
    """LQ tracking with a reduced model of some trajectories."""
    model = pdeloop.identify(*trajectories, n_s=ORDER)
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


# Convection


def _convection(budgets: list[int], seeds: int, cells: int) -> Iterator[Row]:
    convection = Convection(cells)
    plant, rest = DynamicsPlant(convection), convection.target

    def row(name: str, episodes: list[EpisodeRecord], spent: Any) -> Row:
        nu = [convection.nusselt(episode.states[1:, 0]) for episode in episodes]
        every, last = ([float(own[-count:].mean()) for own in nu] for count in (100, 10))
        cost = [float(episode.costs.mean[0]) for episode in episodes]
        return {
            "controller": name,
            "Nu, all actions": _shown(every),
            "Nu, last ten": _shown(last),
            "cost": _shown(cost),
            "episodes": spent,
            "by": "here",
        }

    source = {"Nu, all actions": "", "Nu, last ten": "about 1", "cost": "", "episodes": 6000}
    yield {"controller": "PPO", **source, "by": "beacon"}
    nothing = np.zeros((1, convection.n_a))
    yield row("none", [pdeloop.rollout(plant, lambda k, z: nothing, [0])], 0)
    yield row("proportional to the column mean of v", [_proportional(convection, plant)], 0)
    whole: list[EpisodeRecord] = []
    probed: list[EpisodeRecord] = []
    points = convection.grid.equally_spaced(PROBES)
    places = (points + convection.grid.points * np.arange(3)[:, None]).ravel()
    every = np.arange(convection.grid.size)
    for seed in range(seeds):
        explored = _explored(convection, seed)
        for seen, found in ((every, whole), (places, probed)):
            data = [(states[:, seen] - rest[seen], actions) for states, actions in explored]
            model = pdeloop.identify(*data, n_s=ORDER)
            weights = {"state_weight": 1.0 / len(seen), "action_weight": convection.action_weight}
            K = pdeloop.track(model, **weights).K_a @ model.U.T
            held = _feedback(K, rest[seen], seen)
            found.append(pdeloop.rollout(plant, held, [0]))
    short = f"{EXPLORED} of {HELD} actions"
    yield row(f"LQR explored from rest, order {ORDER}", whole, short)
    yield row("the same with 4 x 4 probes", probed, short)
    for budget in budgets:
        how = {"reduced_order": 10, "exploration_variance": 0.3}
        made = [_trained(lambda: Convection(cells), seed, budget, **how) for seed in range(seeds)]
        found = [pdeloop.rollout(plant, law, [0]) for law, _ in made]
        yield row(f"{_name(budget)} from convection", found, max(spent for _, spent in made))


def _feedback(K: Array, rest: Array, seen: Any) -> Law:
    """a = K (y - y_r) of the numbers of a state that are seen."""
    return lambda k, z: (z[:, seen] - rest) @ K.T


def _explored(convection: Convection, seed: int) -> list[tuple[Array, Array]]:
    """Short rollouts with small random actions, each from the resting fluid, heated from below."""
    short = DynamicsPlant(convection, horizon=HELD)
    drawn = np.random.default_rng(seed).standard_normal((HELD, EXPLORED, convection.n_a))
    resting = np.tile(convection.target, (EXPLORED, 1))
    episode = pdeloop.rollout(short, lambda k, z: QUIET * drawn[k], resting)
    return [(episode.states[:, m], episode.actions[:, m]) for m in range(EXPLORED)]


def _proportional(convection: Convection, plant: DynamicsPlant) -> EpisodeRecord:
    """The best of seven gains of a_j = -g mean v above heater j."""
    episodes = []
    for gain in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0):

        def law(k: int, z: Array, gain: float = gain) -> Array:
            v = convection.grid.fields(z)[:, 2].mean(axis=1)
            wanted: Array = -gain * v.reshape(len(z), convection.n_a, -1).mean(axis=2)
            return wanted

        episodes.append(pdeloop.rollout(plant, law, [0]))
    return min(episodes, key=lambda e: float(convection.nusselt(e.states[1:, 0]).mean()))


# One dimension


def _one_dimension(known: BoundaryControlled, budgets: list[int], seeds: int) -> Iterator[Row]:
    plant = DynamicsPlant(known)
    gain = transport_gain if isinstance(known, Transport) else reaction_gain

    def row(name: str, laws: list[Law], spent: Any) -> Row:
        costs = [pdeloop.rollout(plant, law, FIELDS, keep=False).costs.mean.mean() for law in laws]
        return {"controller": name, "mean stage cost": _shown(costs), "episodes": spent}

    k = gain(known.beta)
    yield row("none", [lambda i, z: np.zeros((len(z), 1))], 0)
    yield row("backstepping, which knows the PDE", [lambda i, z: z @ k[:, None]], 0)
    for budget in budgets:
        laws = [_trained(type(known), seed, budget, reduced_order=10) for seed in range(seeds)]
        spent = max(count for _, count in laws)
        yield row(_name(budget), [law for law, _ in laws], spent)
    K, _ = pdeloop.track_horizon(known.A, known.B, plant.cost, np.eye(plant.n_z))
    yield row("limit: exact LQR of the horizon", [lambda i, z: z @ K[i].T], "")
