# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What the published tasks have in common: rows, a first law and a training at a budget."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import pdeloop
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plants import DynamicsPlant
from pdeloop.episode import Law
from pdeloop.finished_run import FinishedRun

Row = dict[str, Any]
LEAST = 6
"""Rollouts that a training takes as it is: two explorations, one of the first law and three that judge;
with fewer it judges by fewer."""


def shown(values: Any, worst: Callable[[Any], Any] = np.max, digits: int = 5) -> str:
    """The mean of several seeds, with the worst in brackets."""
    found = np.atleast_1d(values)
    extra = f" ({worst(found):.{digits}g})" if len(found) > 1 else ""
    return f"{np.mean(found):.{digits}g}{extra}"


def first_law(plant: Dynamics, seed: int, **how: Any) -> Law:
    """LQ tracking on the regression of one exploratory episode."""
    loop = DynamicsPlant(plant)
    explored = pdeloop.problem(plant=plant, **how).explore(seed)
    model = pdeloop.identify(explored, n_s=how["reduced_order"], constant=None)
    weights = {name: getattr(loop, name) for name in ("state_weight", "action_weight")}
    gains = pdeloop.track(model, **weights, cost=loop.cost)
    return pdeloop.projected_law(loop, model.U, gains.policy)


def training(
    plant: Callable[[], Dynamics], seed: int, rollouts: int, **how: Any
) -> tuple[FinishedRun, int]:
    """A training, and how many rollouts it took."""
    if rollouts < LEAST:
        how["optimizer_settings"] = {"judging": rollouts - LEAST + 3}
    run = pdeloop.train(plant=plant(), seed=seed, rollouts=rollouts, evaluation_fields=1, **how)
    return run, sum(run.rollouts[0][part] for part in ("exploration", "check", "adaptation"))


def trained(plant: Callable[[], Dynamics], seed: int, rollouts: int, **how: Any) -> tuple[Law, int]:
    """The affine law of a training, and how many rollouts it took; of one, that of the exploration."""
    if rollouts == 1:
        return first_law(plant(), seed, **how), 1
    run, spent = training(plant, seed, rollouts, law="affine", **how)
    return pdeloop.projected_law(DynamicsPlant(plant()), run.models[0].U, run.policies[0]), spent


def trainings(
    plant: Callable[[], Dynamics], budgets: list[int], seeds: int, **how: Any
) -> Iterator[tuple[str, list[Law], int]]:
    """Name, laws and rollouts of the first law of a training, and of trainings with each budget.

    Of a budget of one rollout there is none: the first law is designed on a model that a training fits.
    """
    for i, budget in enumerate(budget for budget in budgets if budget > 1):
        made = [training(plant, seed, budget, **how) for seed in range(seeds)]
        if i == 0:
            explored = max(run.rollouts[0]["exploration"] for run, _ in made)
            yield "its first law", [run.law("lqt") for run, _ in made], explored
        yield name_of(budget), [run.law() for run, _ in made], max(spent for _, spent in made)


def name_of(budget: int) -> str:
    """What a budget is spent on."""
    return "the first law" if budget == 1 else "`pdeloop.train`"
