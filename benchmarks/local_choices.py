# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Choices after local steps, where no model predicts rollouts: pairs of rollouts alone decide."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.settings import ModelBasedSettings
from loop_method.adapt.verdict import ADAPTED, FIRST, NONE, choose, evidence_of_pairs


@dataclass(frozen=True, eq=False)
class Pairs:
    """What laws cost from many fields, and how a training compared them.

    Attributes
    ----------
    before, found, returned : (N,) arrays
        On the plant: the law that the steps began with, the law that they found, and that returned.
    base, chosen : str
        The law to stay with, and the one that the training chose.
    pairs : int
        Fields on which the training compared them.
    """

    before: Array
    found: Array
    returned: Array
    base: str
    chosen: str
    pairs: int

    @classmethod
    def of(cls, kept: Mapping[str, Any]) -> Pairs:
        """From its attributes as JSON."""
        arrays = {
            name: np.array(kept[name], dtype=float) for name in ("before", "found", "returned")
        }
        return cls(**{**kept, **arrays})


def pairs_of(
    state: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    laws: tuple[Array, Array],
    costs: Callable[[Array], Array],
    explorations: int,
) -> Pairs | None:
    """The table of a training that ended with the verdict on local steps; None of any other one.

    state, rows: of the optimiser, and its history; laws: the first and the returned one; costs: those
    of a law from all fields; explorations: their number.
    """
    if rows[-1].get("role") != "confirming":
        return None
    first, returned = laws
    from_none = bool(state["local.from_none"])
    before = np.zeros_like(first) if from_none else first
    known = len(state["local.none_costs"]) if from_none else int(rows[0]["rollouts"]) - explorations
    asked = int(rows[-1]["rollouts"]) - int(rows[-2]["rollouts"])
    return Pairs(
        costs(before),
        costs(np.asarray(state["local.search.policy"], dtype=float)),
        costs(returned),
        NONE if from_none else FIRST,
        str(rows[-1]["chosen"]),
        asked if asked <= known else known + (asked - known) // 2,
    )


def judge(table: Pairs, draws: int, seed: int) -> dict[str, Any]:
    """As `choices.judge`."""
    rng = np.random.default_rng([seed, table.pairs])
    confidence = ModelBasedSettings().confidence
    chosen = []
    for _ in range(draws):
        own = rng.permutation(len(table.before))[: table.pairs]
        costs = {table.base: table.before[own], ADAPTED: table.found[own]}
        found = choose(evidence_of_pairs(costs, table.base), table.base, confidence)
        chosen.append(found.chosen == ADAPTED)
    stays = table.before.mean()
    change, helped = float(table.found.mean() / stays - 1.0), float(np.mean(chosen))
    own_change = float(table.returned.mean() / stays - 1.0)
    return {
        "helped": helped,
        "wrong": helped * (change > 0.0),
        "missed": (1.0 - helped) * (change < -0.01),
        "none_wrong": 0.0,
        "change": helped * change,
        "worst": max(change, 0.0) if helped else 0.0,
        "possible": min(change, 0.0),
        "chosen": table.chosen,
        "own_change": own_change,
        "own_wrong": bool(table.chosen == ADAPTED and own_change > 0.0),
    }
