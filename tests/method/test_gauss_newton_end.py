# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The end of a training by Gauss-Newton: which law is returned, after which comparisons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from loop_method.adapt import GaussNewton, Rollout, field_step
from loop_method.adapt.base import Record
from loop_method.adapt.proposal import Proposal
from loop_method.adapt.proposer import Proposer
from tests.support.lifted_plant import N_S, Plant, make, measure, same_state
from tests.support.small import same_bits


def finished(
    optimizer: GaussNewton, plant: Plant, cost: Callable[[np.ndarray, int], float] | None = None
) -> tuple[list[Rollout], list[dict[str, Any]]]:
    """All that an optimiser asks for, and its history; cost: another one of a policy and a seed.

    It is continued from a checkpoint at every step, which has to make no difference.
    """
    asked, rows = [], []
    while not optimizer.done:
        now = optimizer.ask()
        results = measure(plant, now)
        if cost is not None:
            results = [
                replace(result, cost=cost(rollout.policy, rollout.field_seed))
                for rollout, result in zip(now, results, strict=True)
            ]
        again = make(
            plant, optimizer._first, rollouts=optimizer._budget, context=optimizer._context
        )
        again.restore(optimizer.state())
        rows.append(optimizer.tell(results))
        assert again.tell(results) == rows[-1] and same_state(again, optimizer)
        asked += now
    return asked, rows


def without_field_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that all steps are local."""
    monkeypatch.setattr(field_step, "field_model", lambda *_, **__: (None, False, 0.0))


@pytest.mark.parametrize("helped", [True, False])
def test_without_a_model_what_was_found_is_compared_on_the_same_fresh_fields(
    helped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A law that was better on the fields that it was made on, and is worse on all others."""
    without_field_models(monkeypatch)
    plant = Plant()
    first = 0.6 * plant.best
    known = [rollout.field_seed for rollout in make(plant, rollouts=17).ask()]

    def cost(policy: np.ndarray, seed: int) -> float:
        own = 5.0 + seed % 7
        return own if same_bits(policy, first) else own * (0.9 if helped or seed in known else 1.1)

    none = plant.run(np.zeros_like(first), 9)
    assert none.trajectory is not None
    measured = [Record(np.zeros_like(first), 99.0, none.trajectory.states, none.trajectory.actions)]
    context = replace(plant.context(), measured=measured)
    optimizer = make(plant, rollouts=17, context=context)
    asked, rows = finished(optimizer, plant, cost)
    last = [row["role"] for row in rows].index("judging")
    assert last == len(rows) - 1 and any(row.get("accepted") for row in rows)
    judged = asked[-(rows[-1]["rollouts"] - rows[-2]["rollouts"]) :]
    half = len(judged) // 2
    assert half >= 2 and len(asked) <= 17
    assert all(same_bits(rollout.policy, first) for rollout in judged[:half])
    seeds = [rollout.field_seed for rollout in judged]
    assert seeds[:half] == seeds[half:], "in pairs"
    assert not set(seeds) & {rollout.field_seed for rollout in asked[: -len(judged)]}, "fresh"
    assert rows[-1]["chosen"] == ("adapted" if helped else "first") and rows[-1]["reason"]
    assert same_bits(optimizer.policy, first) is not helped


def test_without_a_model_no_control_is_returned_where_it_is_better(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    without_field_models(monkeypatch)
    plant = Plant()

    def cost(policy: np.ndarray, seed: int) -> float:
        return 5.0 + seed % 7 + 9.0 * float(policy.any())

    optimizer = make(plant, rollouts=23)
    _, rows = finished(optimizer, plant, cost)
    assert rows[-1]["chosen"] == "none" and not optimizer.policy.any()


@pytest.mark.parametrize("better", [True, False])
def test_a_first_law_that_its_check_refused_is_tried_on_all_fields(
    better: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One field is chance: what is returned is the better one of no control and the first law."""
    without_field_models(monkeypatch)
    plant = Plant()
    first = 0.6 * plant.best

    def cost(policy: np.ndarray, seed: int) -> float:
        if not policy.any():
            return 10.0 + seed % 7
        return 30.0 if not same_bits(policy, first) else 8.0 if better else 12.0 + seed % 7

    context = replace(plant.context(), refused=first)
    optimizer = make(plant, np.zeros_like(first), rollouts=17, context=context)
    asked, rows = finished(optimizer, plant, cost)
    assert not any(rollout.policy.any() for rollout in asked[:3])
    assert same_bits(asked[3].policy, first)
    assert same_bits(optimizer.policy, first if better else np.zeros_like(first))
    assert rows[-1]["chosen"] == ("first" if better else "none")


@pytest.mark.parametrize(
    ("law", "rollouts", "better"),
    [((50.0, 50.0, 120.0), 3, True), ((50.0, 90.0, 120.0), 3, False), ((50.0, 210.0), 2, False)],
)
def test_with_sensors_the_first_law_has_to_beat_no_control_on_all_fields(
    law: tuple[float, ...], rollouts: int, better: bool
) -> None:
    """One field of three is dear without control; the law is given up when it cannot win any more."""
    plant = Plant()
    optimizer = make(plant, context=replace(plant.context(), sensors=N_S))
    none, first = optimizer.ask(), plant.best
    assert len(none) == 3 and not any(asked.policy.any() for asked in none)
    results = measure(plant, none)
    optimizer.tell(
        [
            replace(result, cost=cost)
            for result, cost in zip(results, (34.0, 34.0, 185.0), strict=True)
        ]
    )
    for cost in law:
        (asked,) = optimizer.ask()
        assert same_bits(asked.policy, 0.6 * first)
        row = optimizer.tell([replace(plant.run(asked.policy, asked.field_seed), cost=cost)])
    assert row["accepted"] is better and row["rollouts"] == 3 + rollouts
    assert same_bits(optimizer.policy, 0.6 * first if better else np.zeros_like(first))


@pytest.mark.parametrize(("gain", "elsewhere"), [(0.5, -1.0), (0.02, 0.02), (0.02, -0.1)])
def test_with_sensors_the_law_found_is_compared_on_fresh_fields_unless_its_gain_is_clear(
    gain: float, elsewhere: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rollouts that a clear gain saves make another step, here one back, which is rejected."""
    plant = Plant()
    first, found = 0.6 * plant.best, 0.7 * plant.best
    steps = (Proposal(policy, 1.0, 1, 0.0, 0.1) for policy in (found, first))
    monkeypatch.setattr(Proposer, "propose", lambda *_, **__: next(steps, None))
    context = replace(plant.context(), sensors=N_S)
    optimizer = make(plant, first, rollouts=14, context=context)
    fields: list[list[int]] = []
    while not optimizer.done:
        again = make(plant, first, rollouts=14, context=context)
        again.restore(optimizer.state())
        asked, share = again.ask(), elsewhere if again._comparison else gain
        fields.append([rollout.field_seed for rollout in asked])
        results = []
        for rollout, result in zip(asked, measure(plant, asked), strict=True):
            own = 5.0 - 5.0 * share * same_bits(rollout.policy, found)
            cost = own if rollout.policy.any() else 50.0
            results.append(replace(result, cost=cost + rollout.field_seed % 3))
        row = optimizer.tell(results)
    chosen = "first" if elsewhere == -0.1 else "adapted"
    assert row["chosen"] == chosen and row["rollouts"] <= 14
    assert same_bits(optimizer.policy, found if chosen == "adapted" else first)
    if gain == 0.5:
        assert row["accepted"] is False and row["reason"].endswith("on the fields of the steps")
    else:
        seen = {seed for some in fields[:-1] for seed in some}
        assert row["role"] == "judging" and row["rollouts"] == 14 and len(fields[-1]) == 4
        assert fields[-1][:2] == fields[-1][2:] and not seen & set(fields[-1])


def test_an_end_before_the_budget_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = Plant()
    optimizer = make(plant)
    monkeypatch.setattr(Proposer, "propose", lambda *given, **named: None)
    why = "no model gives a finite step that lowers the cost"
    row = optimizer.tell(measure(plant, optimizer.ask()))
    assert row["reason"] == why and row["rollouts"] == 3
    row = optimizer.tell(measure(plant, optimizer.ask()))
    assert row["early"] == why
    assert (
        optimizer.done and row["rollouts"] == 23 and same_bits(optimizer.policy, 0.6 * plant.best)
    )
    assert row["chosen"] == "first" and str(row["reason"]).startswith(
        f"{why}; no other law is better"
    )
