# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`rayleigh-v0` of beacon: Rayleigh-Bénard convection in a square."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

import pdeloop
from benchmarks.tasks.common import Row, name_of, shown, trained
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plants import DynamicsPlant
from pde_sim_node.plants.convection import Convection
from pdeloop.episode import EpisodeRecord, Law
from pdeloop.messages.arrays import Array

PROBES = 16
"""Of the convection, 4 x 4."""
EXPLORED, HELD = 10, 8
"""Rollouts from rest with which the convection is explored, and their actions."""
QUIET = 1e-3
"""Standard deviation of these actions: so small that what they begin is still linear."""
ORDER = 8
MODES = 10, 20
"""POD modes of an exploration from convection that the law explored from rest is projected on."""
EXCITED = 0.3
"""Variance of the exploration from convection."""
TRAINED = 10
"""First seed of the trainings."""


class Admissible(Convection):
    """The same with declared limits: an action is replaced by the nearest that the source admits."""

    zero_mean = True
    action_low, action_high = -0.75, 0.75

    def actuated(self, a: Array) -> Array:
        """See `Dynamics.actuated`."""
        return Dynamics.actuated(self, a)


def rows(budgets: list[int], seeds: int, cells: int = 50) -> Iterator[Row]:
    convection = Convection(cells)
    plant, rest = DynamicsPlant(convection), convection.target

    def row(name: str, episodes: list[EpisodeRecord], spent: Any) -> Row:
        nu = [convection.nusselt(episode.states[1:, 0]) for episode in episodes]
        every, last = ([float(own[-count:].mean()) for own in nu] for count in (100, 10))
        cost = [float(episode.costs.mean[0]) for episode in episodes]
        return {
            "controller": name,
            "Nu, all actions": shown(every),
            "Nu, last ten": shown(last),
            "cost": shown(cost),
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
    projected: dict[int, list[EpisodeRecord]] = {count: [] for count in MODES}
    points = convection.grid.equally_spaced(PROBES)
    places = (points + convection.grid.points * np.arange(3)[:, None]).ravel()
    every = np.arange(convection.grid.size)
    for seed in range(seeds):
        explored = _explored(convection, seed)
        for seen, found in ((every, whole), (places, probed)):
            data = [(states[:, seen] - rest[seen], actions) for states, actions in explored]
            model = pdeloop.identify(*data, n_s=ORDER, constant=None)
            weights = {"state_weight": 1.0 / len(seen), "action_weight": convection.action_weight}
            K = pdeloop.track(model, **weights).K_a @ model.U.T
            held = _feedback(K, rest[seen], seen)
            found.append(pdeloop.rollout(plant, held, [0]))
            if seen is every:
                for count, own in projected.items():
                    V = _modes(convection, seed, count)
                    own.append(pdeloop.rollout(plant, _feedback(K @ V @ V.T, rest, every), [0]))
    short = f"{EXPLORED} of {HELD} actions"
    yield row(f"LQR explored from rest, order {ORDER}", whole, short)
    for count, own in projected.items():
        yield row(f"the same on {count} POD modes of convection", own, short)
    yield row("the same with 4 x 4 probes", probed, short)
    for budget in budgets:
        how = {"reduced_order": MODES[-1], "exploration_variance": EXCITED}
        # Inputs of mean zero are not told apart by `pdeloop.identify`.
        kind, begin = (Convection, 0) if budget == 1 else (Admissible, TRAINED)
        taken = range(begin, begin + seeds)
        made = [trained(partial(kind, cells), seed, budget, **how) for seed in taken]
        found = [pdeloop.rollout(DynamicsPlant(kind(cells)), law, [0]) for law, _ in made]
        yield row(f"{name_of(budget)} from convection", found, max(spent for _, spent in made))


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


def _modes(convection: Convection, seed: int, count: int) -> Array:
    """Orthonormal POD modes (n_z, count) of one exploration from convection."""
    explored = pdeloop.problem(plant=convection, exploration_variance=EXCITED).explore(seed)
    V: Array = np.linalg.svd(explored[0] - convection.target, full_matrices=False)[2][:count].T
    return V


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
