# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What the published tasks have in common: rows, a first law and a training at a budget."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import pdeloop
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plants import DynamicsPlant
from pdeloop.episode import Law

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
    model = pdeloop.identify(explored, n_s=how["reduced_order"])
    weights = {name: getattr(loop, name) for name in ("state_weight", "action_weight")}
    gains = pdeloop.track(model, **weights, cost=loop.cost)
    return pdeloop.projected_law(loop, model.U, gains.policy)


def trained(plant: Callable[[], Dynamics], seed: int, rollouts: int, **how: Any) -> tuple[Law, int]:
    """The law of a training, and how many rollouts it took; of one, that of the exploration."""
    made = plant()
    if rollouts == 1:
        return first_law(made, seed, **how), 1
    if rollouts < LEAST:
        how["optimizer_settings"] = {"judging": rollouts - LEAST + 3}
    how["rollouts"] = rollouts
    with tempfile.TemporaryDirectory() as folder:
        found = pdeloop.train(
            plant=made, seed=seed, evaluation_fields=1, out=Path(folder) / "run", **how
        )
        spent = sum(found.rollouts[0][part] for part in ("exploration", "check", "adaptation"))
    return found.law(), spent


def name_of(budget: int) -> str:
    """What a budget is spent on."""
    return "the first law" if budget == 1 else "`pdeloop.train`"
