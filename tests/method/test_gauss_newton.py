# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton on measured trajectories: a known optimum, its steps and how they are judged."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from loop_method.adapt import Context, RolloutResult, field_step, final_comparison, local_step
from loop_method.adapt.base import Record
from loop_method.adapt.estimate import Estimate
from loop_method.adapt.proposer import Proposer
from loop_method.adapt.settings import GaussNewtonSettings
from loop_method.models.denoising import denoised
from tests.support.lifted_plant import N_A, N_S, N_Z, Plant, make, mean_cost, measure, same_state
from tests.support.small import FEW_FITS, parameters, same_bits, train_here


def test_converges_to_the_known_optimum_of_a_linear_quadratic_plant() -> None:
    """Large steps first, on three fields; small ones, near the optimum, are judged on more."""
    plant = Plant()
    optimizer = make(plant, rollouts=36)
    start, best = mean_cost(plant, optimizer.policy), mean_cost(plant, plant.best)
    used, counts = 0, []
    while not optimizer.done:
        asked = optimizer.ask()
        used += len(asked)
        optimizer.tell(measure(plant, asked))
        counts.append(optimizer.state()["fields"].size)
        again = make(plant, rollouts=36)
        again.restore(optimizer.state())
        assert same_state(again, optimizer)
    final = mean_cost(plant, optimizer.policy)
    assert start > 1.05 * best
    # The infinite-horizon law is optimal up to the end of the episode.
    assert final == pytest.approx(best, rel=0.01)
    assert used <= 36
    assert counts[0] == 3 and counts == sorted(counts) and 3 < counts[-1] <= 6


def test_improves_a_plant_that_is_not_linear() -> None:
    plant = Plant(bend=0.1)
    optimizer = make(plant)
    start = mean_cost(plant, optimizer.policy)
    while not optimizer.done:
        optimizer.tell(measure(plant, optimizer.ask()))
    assert mean_cost(plant, optimizer.policy) < 0.95 * start


@pytest.mark.parametrize("fraction", [0.0, 0.25, 1.0])
def test_the_law_moves_only_as_far_as_fields_left_out_confirm(
    fraction: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plant is linear, so that a model predicts it; as many rollouts as judge are fresh ones."""
    plant = Plant()
    whole = make(plant, rollouts=6, verdict=False)
    optimizer = make(plant, rollouts=9)
    change = Estimate(-0.5 * fraction, 0.1, 8.0)
    monkeypatch.setattr(final_comparison, "confirmed_fraction", lambda *_, **__: (fraction, change))
    seeds: list[int] = []
    for each in (whole, optimizer):
        while not each.done:
            asked = each.ask()
            seeds += [] if each is whole else [rollout.field_seed for rollout in asked]
            row = each.tell(measure(plant, asked))
    first = 0.6 * plant.best
    moved = whole.policy - first
    assert np.abs(moved).max() > 1e-3
    np.testing.assert_allclose(optimizer.policy - first, fraction * moved, atol=1e-12)
    assert row["chosen"] == ("adapted" if fraction else "first") and row["reason"]
    assert len(seeds) == (9 if fraction else 6)
    assert not set(seeds[6:]) & set(seeds[:6])
    again = make(plant, rollouts=9)
    again.restore(optimizer.state())
    assert again.done and same_state(again, optimizer)


def test_asks_are_pure_rows_are_json_and_the_budget_is_kept() -> None:
    plant = Plant()
    optimizer = make(plant, rollouts=24)
    total, costs = 0, []
    while not optimizer.done:
        first, second = optimizer.ask(), optimizer.ask()
        for a, b in zip(first, second, strict=True):
            assert np.array_equal(a.policy, b.policy)
            assert a.field_seed == b.field_seed
            a.policy[:] = np.nan
        assert np.isfinite(optimizer.ask()[0].policy).all()
        total += len(second)
        row = optimizer.tell(measure(plant, second))
        assert json.loads(json.dumps(row, allow_nan=False)) == row
        assert row["rollouts"] == total
        costs.append(row["cost"])
    left = 24 - total  # fewer rollouts than a step takes on the fields of the end
    assert 0 <= left < len(optimizer.state()["fields"])
    assert optimizer.ask() == []
    with pytest.raises(ValueError, match="done"):
        optimizer.tell([])


def test_candidates_are_judged_on_the_fields_of_the_incumbent() -> None:
    plant = Plant()
    optimizer = make(plant)
    fields = [rollout.field_seed for rollout in optimizer.ask()]
    assert len(set(fields)) == 3
    optimizer.tell(measure(plant, optimizer.ask()))
    seen = []
    for _ in range(3):
        asked = optimizer.ask()
        assert len(asked) == 1
        seen.append(asked[0].field_seed)
        row = optimizer.tell(measure(plant, asked))
    assert seen == fields
    assert row["accepted"] is True
    # After an acceptance the oldest field is replaced by a fresh one.
    fresh = optimizer.ask()
    assert [rollout.field_seed for rollout in fresh] != fields[:1]
    assert fresh[0].field_seed not in fields
    assert np.array_equal(fresh[0].policy, optimizer.policy)


def test_a_clearly_worse_candidate_is_given_up_after_one_rollout() -> None:
    plant = Plant()
    optimizer = make(plant)
    optimizer.tell(measure(plant, optimizer.ask()))
    before = optimizer.policy
    damping = float(optimizer.state()["damping"].item())
    worse = plant.run(np.zeros_like(before), optimizer.ask()[0].field_seed)
    row = optimizer.tell([RolloutResult(1e4, False, worse.trajectory)])
    assert row["accepted"] is False
    assert row["damping"] == 4 * damping
    assert np.array_equal(optimizer.policy, before)


def test_the_damping_is_set_by_the_settings() -> None:
    plant = Plant()
    settings = GaussNewtonSettings(
        first_damping=2.0,
        damping_rejected=5.0,
        largest_damping=7.0,
        damping_fall=4.0,
        good_ratio=0.0,
    )
    for candidate, damping in ((1e4, 7.0), (0.0, 0.5)):
        optimizer = make(plant, settings=settings)
        row = optimizer.tell(measure(plant, optimizer.ask()))
        assert row["damping"] == 2.0
        while "accepted" not in row:
            (asked,) = optimizer.ask()
            row = optimizer.tell(
                [replace(plant.run(asked.policy, asked.field_seed), cost=candidate)]
            )
        assert row["accepted"] is (candidate == 0.0) and row["damping"] == damping


def test_a_candidate_is_given_up_where_the_settings_say() -> None:
    plant = Plant()
    for abort, rollouts in ((1.05, 1), (1.5, 3)):
        optimizer = make(plant, settings=GaussNewtonSettings(abort=abort))
        results = measure(plant, optimizer.ask())
        optimizer.tell([replace(result, cost=10.0) for result in results])
        row: dict[str, Any] = {}
        while "accepted" not in row:
            (asked,) = optimizer.ask()
            row = optimizer.tell([replace(plant.run(asked.policy, asked.field_seed), cost=12.0)])
        assert row["accepted"] is False and row["rollouts"] == 3 + rollouts


def test_all_kinds_of_steps_are_given_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    settings = GaussNewtonSettings(modes=5, pieces=4)

    def field_model(*known: Any) -> tuple[None, bool, float]:
        given.append(known[-1])
        return None, False, 0.0

    def propose(*_: Any, **named: Any) -> None:
        given.append(named["settings"])

    monkeypatch.setattr(field_step, "field_model", field_model)
    monkeypatch.setattr(local_step, "propose", propose)
    plant = Plant()
    optimizer = make(plant, settings=settings)
    optimizer.tell(measure(plant, optimizer.ask()))
    assert given == [settings, settings]


def test_models_of_the_field_are_fitted_to_states_as_measured_and_noise_is_removed_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Their fit knows of the noise; only on a line are initial fields known best by their spectra."""
    fitted: list[Record] = []

    def field_model(_: Context, data: list[Record], *__: Any) -> tuple[None, bool, float]:
        fitted.extend(data)
        return None, False, 0.0

    monkeypatch.setattr(field_step, "field_model", field_model)
    plant = Plant()
    context = replace(plant.context(), noise=0.1)
    optimizer = make(plant, context=context)
    results = measure(plant, optimizer.ask())
    optimizer.tell(results)
    measured = [context.exploration.states, *(r.trajectory.states for r in results if r.trajectory)]
    assert len(fitted) == len(measured) == 4
    assert all(same_bits(r.states, z) for r, z in zip(fitted, measured, strict=True))
    for clean, states in zip(optimizer._proposer._without_noise(fitted), measured, strict=True):
        assert same_bits(clean.states, denoised(states, 0.1))


def test_the_ridges_are_equally_spaced_in_their_logarithm() -> None:
    assert GaussNewtonSettings().ridge_values == (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
    assert GaussNewtonSettings(ridges=1, least_ridge=0.5).ridge_values == (0.5,)


def test_a_step_moves_the_gains_and_the_constant_part_by_what_it_says() -> None:
    plant = Plant()
    proposer = Proposer(plant.context(), plant.best)
    step = np.random.default_rng(8).standard_normal((N_A, N_S + 1))
    moved = proposer.loop.moved(plant.best, step)
    s_r = plant.U.T @ plant.target
    constant = (moved - plant.best)[:, N_S:] @ s_r
    np.testing.assert_allclose((moved - plant.best)[:, :N_S], step[:, :N_S], atol=1e-12)
    np.testing.assert_allclose(constant, step[:, N_S], atol=1e-12)
    np.testing.assert_allclose(
        proposer.loop.theta(moved) - proposer.loop.theta(plant.best), step, atol=1e-12
    )


def test_a_target_outside_of_the_basis_leaves_the_constant_part_alone() -> None:
    plant = Plant()
    outside = np.linalg.qr(np.column_stack([plant.U, np.ones(N_Z)]))[0][:, N_S]
    plant.target = outside
    policy = 0.6 * plant.best
    optimizer = make(plant, policy)
    while not optimizer.done:
        optimizer.tell(measure(plant, optimizer.ask()))
    assert np.array_equal(optimizer.policy[:, N_S:], policy[:, N_S:])


def test_a_reduced_model_larger_than_the_default_number_of_modes_is_adapted() -> None:
    size = {"n_z": 64, "n_a": 2, "reduced_order": 34, "horizon": 80}
    training = train_here(parameters(optimizer="gauss_newton", rollouts=14, **size, **FEW_FITS))
    assert training.policies().shape == (1, 2, 68)
    _, lqt, adapted = training.evaluation.mean(axis=2)[0]
    assert adapted < lqt
