# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`model_based` with a law that estimates the state, on a model of the field between sensors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pdeloop.method.adapt import (
    Rollout,
    Trajectory,
    model_based_sensed,
)
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.model_based import JUDGING
from pdeloop.method.adapt.model_based_sensed import ModelBasedSensed
from pdeloop.method.adapt.sensed_loop import UNPREDICTED, noise_of_filter, sensed_from
from pdeloop.method.laws import ExtendedKalman, Observer
from pdeloop.method.models.sensed import SensedModel
from tests.support.sensed_optimiser import measured, optimiser, small, told
from tests.support.small import same_bits


def test_one_rollout_suffices_and_the_optimiser_continues_with_the_same_bits() -> None:
    later = optimiser()
    assert len(later.ask()) == 1
    first, _, row = told()
    assert row["model"] == "sensed" and float(row["predicted_change"]) < 0.0
    later.restore(first.state())
    rows = []
    for each in first, later:
        while not each.done:
            rows.append(each.tell([measured(asked) for asked in each.ask()]))
    half = len(rows) // 2
    assert rows[:half] == rows[half:] and rows[-1]["chosen"] == "adapted"
    assert same_bits(first.policy, later.policy)


def test_what_a_law_costs_on_the_fields_of_the_first_one_decides() -> None:
    """An equation that reproduces the readings may be wrong between them."""
    own, first, _ = told(better=True, rollouts=7, judging=3)
    fields = [each.field_seed for each in optimiser(rollouts=7, judging=3, first=own._first).ask()]
    costs = {field: result.cost for field, result in zip(fields, first, strict=True)}
    assert len(costs) > 1
    while not own.done:
        asked = own.ask()
        results = [measured(each) for each in asked]
        if own._progress.stage == JUDGING:
            again = [each.field_seed for each in asked]
            assert again == fields[: len(again)] and len(again) == 3
            # A little more than chance explains.
            results = [
                replace(result, cost=costs[each.field_seed] + 5.0 + 0.1 * i)
                for i, (each, result) in enumerate(zip(asked, results, strict=True))
            ]
        row = own.tell(results)
    assert row["chosen"] == "first" and same_bits(own.policy, own._first)


def test_no_control_is_measured_where_it_may_stay_and_the_last_law_on_its_fields() -> None:
    """The first law does nothing either."""
    own, *_ = told(rollouts=7, judging=3)
    asked = own.ask()
    assert not own._progress.safe and asked and not any(each.policy.any() for each in asked)
    own.tell([measured(each) for each in asked])
    judged = own.ask()
    assert own._progress.stage == JUDGING and all(each.policy.any() for each in judged)
    assert {each.field_seed for each in judged} == {each.field_seed for each in asked}


@pytest.mark.parametrize("more", [0.5, 2.0])
def test_a_law_that_measured_better_is_returned_in_place_of_a_last_one_that_beats_the_first(
    more: float,
) -> None:
    """What a law is renewed from may tell less of the plant than what is known already."""
    own, *_ = told(better=True, rollouts=7, judging=3)
    before, final, row = own._first + 1e-6, own._first + 2e-6, dict[str, Any]()
    own._progress.policy = final
    seeds = [record.field_seed for record in own._of(own._first)]
    first = [record.cost for record in own._of(own._first)]
    assert len(first) == 3
    for law, share, fields in ((before, 0.4, [-1] * 3), (final, 0.4 * more, seeds)):
        for seed, (cost, of_field) in enumerate(zip(first, fields, strict=True), start=1):
            result = measured(Rollout(law, seed))
            # Alike from field to field, so that three rollouts decide.
            level = share * (np.mean(first) + 0.01 * (cost - np.mean(first)))
            own._records.add([Rollout(law, of_field)], [replace(result, cost=float(level))])
    own._judge(row)
    assert row["chosen"] == "adapted"
    assert same_bits(own.policy, before if more > 1.0 else final)
    assert ("an earlier adapted law costs" in str(row["reason"])) is (more > 1.0)
    expected = 0.4 * min(more, 1.0) * np.mean(first) - np.mean(first)
    assert row["predicted_change"] == pytest.approx(expected)
    # Of the earlier law's and the first one's rollouts, and of pairs of the last one's.
    off = np.std(first, ddof=1) / np.sqrt(3.0)
    error = np.hypot(off, 0.4 * 0.01 * off) if more > 1.0 else (1.0 - 0.2 * 0.01) * off
    assert row["deviation"] == pytest.approx(error)


def test_a_training_uses_the_filter_that_trusts_the_equation_least_within_its_margin() -> None:
    _, results, _ = told()
    _, context = small()
    assert isinstance(context.law, Observer)
    law = ExtendedKalman(context.law.model, context.horizon)
    settings = ModelBasedSettings(iterations=5, mixtures=2, judging=1, filter_margin=1.0)
    own = ModelBasedSensed(
        law.theta_start,
        seed=0,
        rollouts=3,
        settings=settings,
        context=replace(context, law=law, noise=0.0),
    )
    # Both first laws do nothing.
    own.tell(results)
    assert own._sensed is not None and law.estimates(own.policy)
    noise = law.parts(own.policy)["noise"][0]
    assert noise == noise_of_filter(own._sensed, settings, UNPREDICTED[0])


def test_an_equation_that_the_first_rollouts_did_not_determine_is_looked_for_again() -> None:
    attempts = []

    def late(*given: Any) -> tuple[SensedModel, float] | None:
        attempts.append(given)
        return None if len(attempts) <= 3 else sensed_from(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_based_sensed, "sensed_from", late)
        own, models = optimiser(rollouts=7), []
        for _ in range(4):
            row = own.tell([measured(asked) for asked in own.ask()])
            models.append(row.get("model"))
    assert models[2] == "innovations" and models[3] == "sensed"


@pytest.mark.parametrize("far", [1.0, 100.0])
def test_no_control_follows_a_law_that_runs_away_before_an_equation_is_found(far: float) -> None:
    """Its rollouts show none; those of a law that stays near may. The row tells of what follows."""
    before, *_ = told()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_based_sensed, "sensed_from", lambda *_: None)
        own = optimiser(rollouts=20, judging=3, first=before.policy)
        assert all(asked.policy.any() for asked in own.ask())
        results = [measured(asked) for asked in own.ask()]
        seen = [result.trajectory for result in results if result.trajectory is not None]
        row = own.tell(
            [
                replace(result, trajectory=Trajectory(far * known.states, far * known.actions))
                for result, known in zip(results, seen, strict=True)
            ]
        )
        runs_away = far > 1.0
        assert ("no control is rolled out next" in str(row.get("reason"))) is runs_away
        assert own.policy.any() is not np.bool_(runs_away)
        assert all(asked.policy.any() is not np.bool_(runs_away) for asked in own.ask())
    of_a_law = {"fraction", "steps", "predicted_change", "deviation"} & {*row}
    assert of_a_law == (set() if runs_away else {"steps"})
    assert {"role", "cost", "model"} <= {*row}  # of the rollouts, and of what reproduces them
