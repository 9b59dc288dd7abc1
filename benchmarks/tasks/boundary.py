# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The notebooks of PDEControlGym: transport and reaction-diffusion through one end.

The return is that of the source's `TunedReward1D`, with norms over all points and no dx: each action
that ends at internal step k brings |u_{k-100}| - |u_k|, and the last one 300 - sum |u_end| / 1000 -
|u| with the sum over all internal steps. Laws are designed for the quadratic cost that a plant
declares, and measured by the return.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

import pdeloop
from benchmarks.backstepping import source_reaction_gain, source_transport_gain
from benchmarks.tasks.common import Row, name_of, shown, trained
from pde_sim_node.plants import DynamicsPlant
from pde_sim_node.plants.boundary import BoundaryControlled, ReactionDiffusionBoundary, Transport
from pdeloop.episode import Law
from pdeloop.messages.arrays import Array

STARTS = np.arange(2000, 2050)
"""Seeds of the fifty constants from 1 to 10."""
BEFORE = 100
"""Internal steps between the two norms that an action is rewarded for."""
ORDER = 10
SMALL = 20.0
"""Norm below which the last action is rewarded."""
SOURCE = {
    "reaction-diffusion": (
        ("backstepping", 298.98, 299.82, 298.23, 1275.44, 12754.40, 0),
        ("PPO", 293.19, 294.83, 283.32, 1104.26, 23323.11, 1000),
        ("SAC", 233.11, 236.04, 232.75, 2018.04, 9700.64, 500),
    ),
    "transport": (
        ("backstepping", 243.06, 289.84, 198.38, 106.09, 1060.86, 0),
        ("PPO", 189.98, 244.47, 72.51, 474.52, 1818.50, 20000),
        ("SAC", 179.90, 217.33, 146.10, 646.76, 1347.28, 10000),
    ),
}
"""As the notebooks print them: mean return, return from 1 and 10, sum of norms from 1 and 10, episodes
(1e6 and 5e5 actions)."""


def reaction_diffusion(budgets: list[int], seeds: int) -> Iterator[Row]:
    """R = 1e-4 beside the sum of squares."""
    return rows("reaction-diffusion", budgets, seeds)


def transport(budgets: list[int], seeds: int) -> Iterator[Row]:
    """R = 0.01 beside the sum of squares."""
    return rows("transport", budgets, seeds)


def plant_of(task: str) -> BoundaryControlled:
    """The plant of a task with its declared cost."""
    if task == "transport":
        return Transport(99, length=0.99, action_cost=0.01 / 99)
    return ReactionDiffusionBoundary(action_cost=1e-4 / 200)


def rows(task: str, budgets: list[int], seeds: int) -> Iterator[Row]:
    """The table of a task."""
    known, measure = plant_of(task), Measure(plant_of(task))
    for name, *figures, episodes in SOURCE[task]:
        yield _row(name, [f"{value:.2f}" for value in figures], episodes, "PDEControlGym")

    def row(name: str, laws: list[Law], spent: Any, clipped: bool = True) -> Row:
        found = np.array([measure(law, clipped) for law in laws])
        worst = [np.min] * 3 + [np.max] * 2
        values = [shown(found[:, i], worst[i], 6) for i in range(5)]
        return _row(name, values, spent, "here")

    yield row("none", [lambda k, z: np.zeros((len(z), 1))], 0)
    gain = source_transport_gain if task == "transport" else source_reaction_gain
    b = gain(known)
    yield row("backstepping, which knows the PDE", [lambda k, z: z @ b[:, None]], 0, clipped=False)
    for budget in budgets:
        how = {"reduced_order": ORDER, "identification": "regression"}
        laws = [trained(lambda: plant_of(task), seed, budget, **how) for seed in range(seeds)]
        yield row(name_of(budget), [law for law, _ in laws], max(count for _, count in laws))
        if budget == 1 and task == "reaction-diffusion":
            quick = [dead_beat(known, seed) for seed in range(seeds)]
            yield row("dead-beat law of the unstable mode of that model", quick, 1)
    K, _ = pdeloop.track_horizon(known.A, known.B, measure.plant.cost, np.eye(known.grid.size))
    yield row("exact LQR of the horizon", [lambda k, z: z @ K[k].T], "")
    if task == "reaction-diffusion":
        bounds = [f"{most(known, c):.6g}" for c in (1.0, 10.0)]
        yield _row("best known inputs", ["", *bounds, "", ""], "", "here")


def _row(name: str, figures: Sequence[str], spent: Any, by: str) -> Row:
    heads = ("return", "from 1", "from 10", "Σ norms from 1", "from 10 ")
    return {
        "controller": name,
        **dict(zip(heads, figures, strict=True)),
        "episodes": spent,
        "by": by,
    }


class Measure:
    """Mean return over the starts, return from 1 and from 10, and the sums of norms from there."""

    def __init__(self, known: BoundaryControlled) -> None:
        self.known, self.plant = known, DynamicsPlant(known)
        self.c = np.array([known.initial_state(np.random.default_rng(s))[0] for s in STARTS])
        self.c = np.concatenate([[1.0, 10.0], self.c])

    def __call__(self, law: Law, clipped: bool = True) -> Array:
        """Five figures of a law; clipped: its actions are bounded, as agents' are."""
        known, z = self.known, np.outer(self.c, np.ones(self.known.grid.size))
        steps = known.steps
        A, B = known.advance(steps - BEFORE) if steps > BEFORE else (np.eye(len(z[0])), None)
        returns, norms = np.zeros(len(z)), np.zeros(len(z))
        ends = z[:, -1].copy()
        for k in range(known.horizon):
            a = law(k, z)
            a = np.clip(a, known.action_low, known.action_high) if clipped else a
            before = z @ A.T if B is None else z @ A.T + a @ B.T
            z = z @ known.A.T + a @ known.B.T
            size = np.linalg.norm(z, axis=1)
            norms += size
            ends += steps * np.abs(a[:, 0])
            if k < known.horizon - 1:
                returns += np.linalg.norm(before, axis=1) - size
            else:
                returns += np.where(size < SMALL, 300.0 - ends / 1000.0 - size, 0.0)
        return np.array([returns[2:].mean(), *returns[:2], *norms[:2]])


def unstable(A: Array) -> tuple[float, Array]:
    """The largest eigenvalue of a matrix, and its left eigenvector."""
    values, vectors = np.linalg.eig(A.T)
    largest = int(np.argmax(np.abs(values)))
    return float(values[largest].real), vectors[:, largest].real


def dead_beat(known: BoundaryControlled, seed: int) -> Law:
    """The law that ends the unstable mode of the model of one exploration in a step.

    Of all inputs that end it, those of the first steps need the least sum of |a|.
    """
    explored = pdeloop.problem(plant=known, reduced_order=ORDER).explore(seed)
    model = pdeloop.identify(explored, n_s=ORDER, constant=None)
    growth, left = unstable(model.A)
    K = -growth * (model.U @ left) / float((left @ model.B)[0])
    return lambda k, z: z @ K[:, None]


def most(known: BoundaryControlled, c: float) -> float:
    """A bound on the return from c that no inputs exceed.

    With l the left eigenvector of the growth g > 1, g^-T l u_T = l u_0 + sum_k g^-(k+1) l b a_k, and
    |l u_T| is at most |l| |u_T|. To leave |l u_T| = e saves at most 0.1 g^(H-T) e / |l b| of sum |a|, H
    being the steps that full inputs take, and costs at least e / |l|; as that is more, e is 0, and the
    inputs are full from the beginning.
    """
    growth, left = unstable(known.A)
    needed, effect = abs(float(left.sum()) * c), abs(float(left @ known.B[:, 0]))
    bound, T = float(known.action_high), known.horizon
    spent, k = 0.0, 0
    while needed > 0.0:
        share = effect * growth ** -(k + 1.0)
        a = min(bound, needed / share)
        spent, needed, k = spent + a, needed - share * a, k + 1
    assert 0.1 * growth ** (k - T) / effect < 1.0 / np.linalg.norm(left), "a rest would pay"
    return c * math.sqrt(known.grid.size) + 300.0 - 0.1 * spent - c / 1000.0
