# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Rows of progress.jsonl about what happened in a training. Pure."""

from typing import Any

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import ModelRows
from pdeloop.messages.topics import COMPLETED, CostColumn
from pdeloop.method.adapt import RolloutResult
from tuner_node.batch import TrainingSettings
from tuner_node.rollouts import EVALUATED, variance

Row = dict[str, Any]


def diverged(
    settings: TrainingSettings, m: int, void: int, step: int, paid: int, *, again: bool
) -> Row:
    """A void exploration of the m-th seed, also a row of the history.

    void: how many the seed has had with this one; step: the one at which the plant diverged; paid:
    rollouts of the seed so far; again: whether it explores once more.
    """
    following = {"next_variance": variance(settings, void)} if again else {}
    return {
        "event": "diverged",
        "seed": settings.all_seeds[m],
        "step": step,
        "variance": variance(settings, void - 1),
        **following,
        "rollouts": paid,
    }


def designed(seed: int, attempt: int, model: Array, own: ModelRows) -> Row:
    """A reduced model was identified, and a law designed for it, if it has stabilising gains."""
    return {
        "event": "designed",
        "seed": seed,
        "attempt": attempt,
        "reduced_order": model.shape[1],
        "spectral_radius": float(np.abs(np.linalg.eigvals(own.A)).max()),
        "stabilised": bool(own.K_a.any()),
    }


def measured(seed: int, phase: str, paid: int, costs: Array) -> Row:
    """Rollouts of a seed are over, before anything is made of them.

    paid: rollouts of the seed with these; costs (n, 3): of these, as in episode/cost.
    """
    known = costs[costs[:, CostColumn.ENDED] == COMPLETED, CostColumn.MEAN]
    told = (
        {"cost": known.mean(), "lowest": known.min(), "highest": known.max()} if len(known) else {}
    )
    return {
        "event": "measured",
        "seed": seed,
        "phase": phase,
        "rollouts": paid,
        **{name: float(value) for name, value in told.items()},
        "diverged": len(costs) - len(known),
    }


def checked(seed: int, none: RolloutResult, lqt: RolloutResult, *, good: bool, again: bool) -> Row:
    """No control and the first law were compared on one field."""
    return {
        "event": "checked",
        "seed": seed,
        "none": none.cost,
        "lqt": lqt.cost,
        "diverged": {"none": int(none.diverged), "lqt": int(lqt.diverged)},
        "accepted": good,
        "again": again,
    }


def evaluated(settings: TrainingSettings, evaluation: Array, ended: Array) -> list[Row]:
    """The closing evaluation of each seed; evaluation, ended: see Training."""
    return [
        {
            "event": "evaluated",
            "seed": seed,
            **dict(zip(EVALUATED, costs.mean(axis=-1).tolist(), strict=True)),
            "diverged": dict(zip(EVALUATED, lost.sum(axis=-1).tolist(), strict=True)),
        }
        for seed, costs, lost in zip(
            settings.all_seeds, evaluation, ended != COMPLETED, strict=True
        )
    ]
