# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton on measured trajectories: a known optimum, its safeguards, its checkpoints."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from loop_method.adapt import (
    Context,
    GaussNewton,
    Rollout,
    RolloutResult,
    Trajectory,
    field_step,
    final_comparison,
    local_step,
)
from loop_method.adapt.base import Record
from loop_method.adapt.estimate import Estimate
from loop_method.adapt.proposal import Proposal
from loop_method.adapt.proposer import Proposer
from loop_method.adapt.settings import GaussNewtonSettings
from loop_method.design.lqt import track
from loop_method.models.denoising import denoised
from loop_method.reduce.reduced_model import ReducedModel
from tests.support.small import parameters, same_bits, train_here

N_Z, N_S, N_A, T = 7, 4, 2, 80
Q, R = 1.0, 0.2


class Plant:
    """s' = A s + B a, lifted to N_Z dimensions; `bend` adds a quadratic term."""

    def __init__(self, bend: float = 0.0) -> None:
        rng = np.random.default_rng(0)
        A = rng.standard_normal((N_S, N_S))
        self.A = 1.02 * A / np.abs(np.linalg.eigvals(A)).max()
        self.B = rng.standard_normal((N_S, N_A))
        self.U = np.linalg.qr(rng.standard_normal((N_Z, N_S)))[0]
        self.target = self.U @ np.array([0.5, -0.2, 0.3, 0.1])
        self.bend = bend
        self.model = ReducedModel(A=self.A, B=self.B, U=self.U)
        self.best = track(self.model, state_weight=Q, action_weight=R).policy

    def run(self, policy: np.ndarray, seed: int, noise: np.ndarray | None = None) -> RolloutResult:
        s = np.random.default_rng(seed).standard_normal(N_S)
        b = policy[:, N_S:] @ self.U.T @ self.target
        states, actions, cost = [self.U @ s], [], 0.0
        for k in range(T):
            a = policy[:, :N_S] @ s + b if noise is None else noise[k]
            cost += Q * float(np.sum((states[-1] - self.target) ** 2)) + R * float(a @ a)
            s = self.A @ s + self.B @ a + self.bend * np.tanh(s) * s[::-1]
            actions.append(a)
            if np.abs(s).max() > 1e3:
                done = Trajectory(np.array(states), np.array(actions)[:-1])
                return RolloutResult(1e9, True, done)
            states.append(self.U @ s)
        return RolloutResult(cost / T, False, Trajectory(np.array(states), np.array(actions)))

    def context(self) -> Context:
        noise = 0.3 * np.random.default_rng(1).standard_normal((T, N_A))
        exploration = self.run(np.zeros((N_A, 2 * N_S)), 77, noise).trajectory
        assert exploration is not None
        # No field on an axis, of which many models would be tried.
        return Context(self.U, self.target, Q, R, T, exploration, periodic=False, line=False)


def make(plant: Plant, policy: np.ndarray | None = None, **changes: Any) -> GaussNewton:
    settings: dict[str, Any] = {"seed": 5, "rollouts": 24, "context": plant.context()}
    return GaussNewton(0.6 * plant.best if policy is None else policy, **(settings | changes))


def measure(plant: Plant, asked: list[Rollout]) -> list[RolloutResult]:
    return [plant.run(rollout.policy, rollout.field_seed) for rollout in asked]


def mean_cost(plant: Plant, policy: np.ndarray) -> float:
    return float(np.mean([plant.run(policy, 10**6 + i).cost for i in range(40)]))


def same_state(a: GaussNewton, b: GaussNewton) -> bool:
    one, other = a.state(), b.state()
    return one.keys() == other.keys() and all(same_bits(one[k], other[k]) for k in one)


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
    why = "no model gives a finite step that gains anything"
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


def diverged(plant: Plant, rollout: Rollout, tail: str) -> RolloutResult:
    result = plant.run(rollout.policy, rollout.field_seed)
    assert result.trajectory is not None
    states, actions = result.trajectory.states.copy(), result.trajectory.actions.copy()
    if tail == "nan":
        states[9:], actions[9:] = np.nan, np.nan
    elif tail == "frozen":
        states[9:] = states[9]
    elif tail == "huge":
        states[9:] *= 1e30
    elif tail == "empty":
        states, actions = states[:1], actions[:0]
    return RolloutResult(1e9 if tail != "nan" else np.nan, True, Trajectory(states, actions))


@pytest.mark.parametrize("tail", ["nan", "frozen", "huge", "empty"])
def test_a_diverged_candidate_stays_out_of_the_policy_and_of_the_model(tail: str) -> None:
    plant = Plant()
    optimizer = make(plant, rollouts=16)
    optimizer.tell(measure(plant, optimizer.ask()))
    before = optimizer.policy
    for _ in range(3):
        row = optimizer.tell([diverged(plant, optimizer.ask()[0], tail)])
        assert row["diverged"] == 1
        assert row["accepted"] is False
        assert json.dumps(row, allow_nan=False)
    assert np.array_equal(optimizer.policy, before)
    kept = [a for name, a in optimizer.state().items() if name.endswith(".states")]
    assert sum(map(len, kept)) < 4 * (T + 1)
    start = mean_cost(plant, before)
    while not optimizer.done:
        optimizer.tell(measure(plant, optimizer.ask()))
    assert mean_cost(plant, optimizer.policy) < start


def test_a_warm_start_that_diverges_is_halved_until_it_does_not() -> None:
    plant = Plant()
    wild = 8.0 * plant.best
    optimizer = make(plant, wild)
    results = measure(plant, optimizer.ask())
    assert all(result.diverged for result in results)
    row = optimizer.tell(results)
    assert "cost" not in row
    assert np.array_equal(optimizer.ask()[0].policy, 0.5 * wild)
    while not optimizer.done:
        row = optimizer.tell(measure(plant, optimizer.ask()))
        assert json.dumps(row, allow_nan=False)
    assert mean_cost(plant, optimizer.policy) < 1.1 * mean_cost(plant, plant.best)


def test_only_divergence_never_moves_the_policy() -> None:
    plant = Plant()
    optimizer = make(plant, rollouts=12)
    before = optimizer.policy
    while not optimizer.done:
        optimizer.tell([diverged(plant, rollout, "nan") for rollout in optimizer.ask()])
    assert np.array_equal(optimizer.policy, before)


def test_a_restored_training_ends_with_the_same_bits() -> None:
    plant = Plant(bend=0.1)

    def step(optimizer: GaussNewton) -> dict[str, Any]:
        asked = optimizer.ask()
        results = measure(plant, asked)
        if optimizer.tells == 4:
            results[0] = diverged(plant, asked[0], "nan")
        return optimizer.tell(results)

    # What a step leaves follows from what is kept before it, so restoring may come anywhere.
    whole = make(plant, rollouts=17)
    while not whole.done:
        stored = io.BytesIO()
        np.savez(stored, **whole.state())
        stored.seek(0)
        again = make(plant, rollouts=17)
        with np.load(stored, allow_pickle=False) as arrays:
            again.restore(dict(arrays))
        assert step(again) == step(whole)
        assert same_state(again, whole)
    assert whole.tells > 8


def test_continues_from_a_checkpoint_with_the_names_of_an_older_version() -> None:
    plant = Plant()
    optimizer = make(plant)
    for _ in range(3):
        optimizer.tell(measure(plant, optimizer.ask()))
    older = optimizer.state()
    older["others"] = older.pop("compared")
    again = make(plant)
    again.restore(older)
    assert same_state(again, optimizer)


def test_refuses_foreign_checkpoints() -> None:
    plant = Plant()
    optimizer = make(plant)
    optimizer.tell(measure(plant, optimizer.ask()))
    good = optimizer.state()
    with pytest.raises(ValueError, match="no array 'candidate'"):
        make(plant).restore({"policy": optimizer.policy})
    with pytest.raises(ValueError, match=r"no array 'record1\.states'"):
        make(plant).restore({k: v for k, v in good.items() if k != "record1.states"})
    with pytest.raises(ValueError, match=r"expected 'record1\.states'"):
        make(plant).restore(good | {"record1.states": good["record1.states"][:, :0]})
    with pytest.raises(ValueError, match="states and"):
        make(plant).restore(good | {"record1.states": good["record1.states"][:1]})
    with pytest.raises(ValueError, match=r"lacks: \[1\]"):
        make(plant).restore(good | {"stamps": np.array([0, 2])})


def test_needs_sound_trajectories_and_stays_as_it_was_without() -> None:
    plant = Plant()
    optimizer = make(plant)
    good = measure(plant, optimizer.ask())
    trajectory = good[0].trajectory
    assert trajectory is not None
    broken = Trajectory(trajectory.states * np.nan, trajectory.actions)
    short = Trajectory(trajectory.states[:-4], trajectory.actions)
    for bad, message in (
        (RolloutResult(1.0), "learns from trajectories"),
        (RolloutResult(1.0, False, broken), "finite trajectory"),
        (RolloutResult(1.0, False, short), "T or T"),
    ):
        with pytest.raises(ValueError, match=message):
            optimizer.tell([*good[:2], bad])
    assert optimizer.tells == 0
    assert len(optimizer.ask()) == 3
    optimizer.tell(good)
    with pytest.raises(ValueError, match="one result per rollout, 1, but got 3"):
        optimizer.tell(good)


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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rollouts": 0}, "rollouts must be positive"),
        ({"policy": np.zeros((2, 6))}, "does not match a basis"),
        ({"policy": np.zeros((3, 8))}, "exploratory trajectory must have"),
    ],
)
def test_refuses_bad_parameters(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(Plant(), **changes)


def test_a_reduced_model_larger_than_the_default_number_of_modes_is_adapted() -> None:
    size = {"n_z": 64, "n_a": 2, "reduced_order": 34, "horizon": 80}
    training = train_here(parameters(optimizer="gauss_newton", rollouts=14, **size))
    assert training.policies().shape == (1, 2, 68)
    _, lqt, adapted = training.evaluation.mean(axis=2)[0]
    assert adapted < lqt
