# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer that is designed and improved on a model of the field between sensors."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import pdeloop
from loop_interfaces.model_rows import ModelRows
from loop_method.adapt import (
    Context,
    ModelBased,
    Optimizer,
    Record,
    Rollout,
    RolloutResult,
    Trajectory,
    model_based_sensed,
)
from loop_method.adapt.belief import Belief
from loop_method.adapt.model_based_readings import ModelBasedReadings
from loop_method.adapt.model_based_sensed import ModelBasedSensed, cheapest, gained, weighted
from loop_method.adapt.observer_design import compensators, law_theta
from loop_method.adapt.progress import JUDGING
from loop_method.adapt.sensed_loop import SensedLoop, sensed_from, sensed_loop
from loop_method.adapt.settings import ModelBasedSettings
from loop_method.adapt.whole_field_law import WholeFieldLaw, whole_field_law
from loop_method.laws import Observer
from loop_method.models.files import model_of
from loop_method.models.sensed import (
    Actuators,
    SensedModel,
    interpolated,
    sensed_model,
)
from loop_method.models.sensed_fit import fit_sensed
from loop_method.models.sensed_smoothing import Smoothing
from loop_method.models.sensed_unknowns import (
    COEFFICIENTS,
    TERMS,
    unknowns,
)
from loop_method.models.settings import DEFAULTS
from pdeloop.episode import rollout
from tests.support.small import same_bits

Array = np.ndarray
SENSORS, N_A, T = 8, 3, 24
FEW_ITERATIONS = replace(DEFAULTS, sensed_iterations=6, sensed_last_iterations=15)
"""For claims that need no exact equation."""
ACTUATORS = Actuators((np.arange(N_A) + 0.5) / N_A, np.zeros(N_A))
RNG = np.random.default_rng(17)


def equation(**terms: float) -> Array:
    """Unknowns of an equation with these terms, like z1 for z and z0_x2 for its second derivative."""
    shared = np.zeros(unknowns(N_A))
    for name, value in terms.items():
        p, j = (int(part) for part in name[1:].split("_x"))
        shared[TERMS.index((p, j))] = value
    shared[COEFFICIENTS] = 5.0  # the strength of the actuators
    return shared


LINEAR = equation(z1_x0=1.5, z1_x1=0.5, z1_x2=0.5)
CUBIC = equation(z1_x0=5.0, z1_x2=0.5, z3_x0=-5.0)


def model_with(shared: Array, noise: float) -> SensedModel:
    return sensed_model(shared, SENSORS, ACTUATORS, 4.0, noise=noise)


def field(model: SensedModel, seed: int) -> Array:
    x = np.arange(model.n_z) / model.n_z
    a, b, c = np.random.default_rng(seed).standard_normal(3)
    drawn: Array = 0.3 * a + b * np.cos(2 * np.pi * x) + c * np.sin(4 * np.pi * x)
    return drawn


def loop_of(model: SensedModel, n_s: int = 10) -> SensedLoop:
    """With a law whose coordinates are any, and more than there are sensors."""
    rng = np.random.default_rng(1)
    U = rng.standard_normal((SENSORS, n_s))
    rows = rows_of(n_s, U)
    target, none = np.zeros(SENSORS), np.zeros((T, N_A))
    explored = Trajectory(np.zeros((T + 1, SENSORS)), none)
    context = Context(U, target, 1.0, 0.1, T, explored, sensors=SENSORS, law=Observer(rows, T))
    return sensed_loop(context, model)


def rows_of(n_s: int, U: Array, n_a: int = N_A) -> ModelRows:
    """Of a law that does nothing."""
    rng = np.random.default_rng(2)
    A, B = 0.3 * rng.standard_normal((n_s, n_s)), rng.standard_normal((n_s, n_a))
    gains = np.zeros((n_a, n_s))
    return ModelRows(A=A, B=B, U=U, K_a=gains, K_b=gains, s_r=np.zeros(n_s))


def test_the_initial_field_is_what_the_readings_came_from() -> None:
    """It moves past the sensors, by three of their distances."""
    moving = equation(z1_x0=1.0, z1_x1=80.0, z3_x0=-1.0)
    model = model_with(moving, 0.0)
    true = field(model, 4)
    z, actions = true[None], 2.0 * RNG.standard_normal((T, N_A))
    seen, every = [], model.n_z // SENSORS
    for a in actions:
        seen.append(z[0, every // 2 :: every])
        z = model.step(z, a[None])
    smoothing = Smoothing(moving, ACTUATORS, 0.0, np.zeros(SENSORS))
    found, error = smoothing.field(np.array(seen), actions, np.nan)
    assert error < 1e-6
    assert np.linalg.norm(found - true) < 0.01 * np.linalg.norm(true)


def test_what_readings_do_not_tell_is_as_large_as_other_rollouts_say() -> None:
    """From eight sensors with noise, whose short waves would otherwise be those of the noise."""
    model, sigma, rng = model_with(CUBIC, 0.0), 0.2, np.random.default_rng(6)
    every, seen, true = model.n_z // SENSORS, [], []
    for seed in range(4):
        z, actions, rows = field(model, seed)[None], 10.0 * rng.standard_normal((T, N_A)), []
        true.append(z[0])
        for a in actions:
            rows.append(z[0, every // 2 :: every] + sigma * rng.standard_normal(SENSORS))
            z = model.step(z, a[None])
        seen.append((np.array(rows), actions, np.nan))
    first = Smoothing(CUBIC, ACTUATORS, sigma, np.zeros(SENSORS))
    learned = first.learned(seen)
    assert learned.spread is not None
    # Means of 0.3, and waves of half of 1 at the first two wavenumbers.
    assert learned.spread[1] > 0.25 and learned.spread[8] < 0.1 * learned.spread[1]
    off = [
        sum(np.sum((each.field(*own)[0] - z) ** 2) for own, z in zip(seen, true, strict=True))
        for each in (learned, first)
    ]
    assert off[0] < 0.7 * off[1]
    # So does the equation.
    readings, taken = [own[0] for own in seen], [own[1] for own in seen]
    known = np.zeros(SENSORS), np.full(len(seen), np.nan)
    off = [
        np.linalg.norm(
            fit_sensed(
                readings, taken, ACTUATORS, sigma, CUBIC, *known, spread, settings=FEW_ITERATIONS
            )[1]
            - np.array(true)
        )
        for spread in (learned.spread, None)
    ]
    assert off[0] < 0.5 * off[1]


def test_a_compensator_does_the_same_in_the_coordinates_of_the_law() -> None:
    loop, n_s, rng = loop_of(model_with(LINEAR, 0.1)), 10, np.random.default_rng(5)
    guess, B = rng.standard_normal((n_s, SENSORS)), rng.standard_normal((n_s, N_A))
    K, D, b = rng.standard_normal((N_A, n_s)), rng.standard_normal((N_A, SENSORS)), np.ones(N_A)
    F, G, c = (
        0.2 * rng.standard_normal((n_s, n_s)),
        rng.standard_normal((n_s, SENSORS)),
        np.ones(n_s),
    )
    law = loop.law
    theta = law.parts(
        loop.policy(law_theta(loop, B, guess, (K, D, b), (F, G, c)), np.zeros(law.size))
    )
    readings = rng.standard_normal((6, SENSORS))
    x, memory = guess @ readings[0], law.memory_start()
    for k, y in enumerate(readings):
        a = K @ x + D @ y + b
        np.testing.assert_allclose(law.action(theta, y, memory, k), a, rtol=1e-6, atol=1e-6)
        memory = law.memory_update(theta, y, memory, a, k)
        x = F @ x + G @ y + c + B @ a


def whole_law(model: SensedModel, count: int) -> tuple[SensedLoop, WholeFieldLaw, Array, Array]:
    """A loop, the law of the whole field from so many initial fields, and these with their weights."""
    loop, fields = loop_of(model), np.stack([field(model, seed) for seed in range(count)])
    every, weights = weighted(fields, np.empty((0, model.n_z)), 0.5)
    law = whole_field_law(loop, every, weights, ModelBasedSettings(iterations=20), 10)
    assert law is not None
    return loop, law, every, weights


@pytest.mark.parametrize("shared", [LINEAR, CUBIC])
def test_the_designed_law_is_near_to_that_of_the_whole_field(shared: Array) -> None:
    """With little noise the readings tell the state, so that the estimate costs little."""
    loop, whole, every, weights = whole_law(model_with(shared, 0.02), 6)
    best = float(whole.simulation.costs.mean())
    law = cheapest(loop, list(compensators(loop, whole, ModelBasedSettings())), every, weights)
    none = float(loop.costs(loop.no_control, every).mean())
    own = float(loop.costs(law, every).mean())
    assert best < 0.9 * none
    assert own - best < 0.25 * (none - best)


def test_the_designed_law_of_the_newest_readings_is_an_optimum_of_their_gains() -> None:
    loop, whole, every, weights = whole_law(model_with(CUBIC, 0.3), 4)
    static = list(compensators(loop, whole, ModelBasedSettings(least_gain=1e-5)))[2]
    n_s, cost = len(loop.law.model.A), float(loop.costs(static, every) @ weights)
    assert not static[:N_A, n_s : 2 * n_s].any()  # of no estimate
    for scale, offset in ((0.8, 0.0), (1.2, 0.0), (1.0, 0.1), (1.0, -0.1)):
        other = static.copy()
        other[:N_A, :n_s] *= scale
        other[:N_A, -1] += offset
        assert float(loop.costs(other, every) @ weights) > cost


def test_the_model_survives_a_checkpoint() -> None:
    model = model_with(CUBIC, 0.3)
    again = Belief.of(Belief(model, 0.01, 1).state())
    assert again is not None and isinstance(again.model, SensedModel)
    z, a = field(model, 1)[None], np.ones((1, N_A))
    assert same_bits(again.model.step(z, a), model.step(z, a))
    assert same_bits(again.model.shared, CUBIC) and again.model.noise == 0.3
    assert isinstance(model_of(model.arrays()), SensedModel)


@cache
def small() -> tuple[pdeloop.Problem, Context]:
    problem = pdeloop.problem("allen-cahn", sensors=SENSORS, horizon=10, exploration_variance=4.0)
    plant = problem.plant()
    explored = [problem.explore(seed) for seed in (0, 1)]
    U = np.random.default_rng(3).standard_normal((SENSORS, 10))
    law = Observer(rows_of(10, U, plant.n_a), plant.horizon)
    first, second = (Trajectory(states, actions) for states, actions in explored)
    context = Context(
        law.model.U,
        plant.target,
        plant.state_weight,
        plant.action_weight,
        plant.horizon,
        first,
        sensors=SENSORS,
        further=[second],
        law=law,
        field_models=FEW_ITERATIONS,
    )
    return problem, context


def measured(asked: Rollout) -> RolloutResult:
    problem, context = small()
    law = context.law
    assert isinstance(law, Observer)
    theta, memory = law.parts(np.ravel(asked.policy)), law.memory_start()

    def act(k: int, y: Array) -> Array:
        nonlocal memory
        a = law.action(theta, y[0], memory, k)
        memory = law.memory_update(theta, y[0], memory, a, k)
        return a[None]

    episode = rollout(problem.plant(), act, [asked.field_seed])
    seen = Trajectory(episode.states[:, 0], episode.actions[:, 0])
    return RolloutResult(float(episode.costs.mean[0]), trajectory=seen)


def optimiser(rollouts: int = 3, judging: int = 1, first: Array | None = None) -> Optimizer:
    _, context = small()
    kind = ModelBased.for_context(context)
    assert kind is ModelBasedSensed
    settings = ModelBasedSettings(iterations=5, observer_iterations=5, mixtures=2, judging=judging)
    law = context.law
    assert law is not None
    start = law.theta_start if first is None else first
    return kind(start, seed=0, rollouts=rollouts, settings=settings, context=context)


@cache
def _told(**given: int) -> tuple[Optimizer, list[RolloutResult], dict[str, Any]]:
    own = optimiser(**given)
    results = [measured(asked) for asked in own.ask()]
    return own, results, dict(own.tell(results))


def told(**given: int) -> tuple[Optimizer, list[RolloutResult], dict[str, Any]]:
    """A copy of an optimiser after its first rollouts, these, and its row: most of what it does."""
    return copy.deepcopy(_told(**given))


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
    before, *_ = told()
    own, costs = optimiser(rollouts=7, judging=3, first=before.policy), {}
    for number in range(100):
        asked = own.ask()
        results = [measured(each) for each in asked]
        if number == 0:
            costs = {each.field_seed: r.cost for each, r in zip(asked, results, strict=True)}
            assert len(costs) > 1
        elif own._progress.stage == JUDGING:
            again = [each.field_seed for each in asked]
            assert again == list(costs)[: len(again)] and len(again) == 3
            # A little more than chance explains.
            results = [
                replace(result, cost=costs[each.field_seed] + 5.0 + 0.1 * i)
                for i, (each, result) in enumerate(zip(asked, results, strict=True))
            ]
        row = own.tell(results)
        if own.done:
            break
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


def test_all_rollouts_of_no_control_are_evidence_against_it() -> None:
    """Of three pairs chance explains the difference, of all of its rollouts it does not."""
    own, (result, *_), row = told(rollouts=7, judging=3)
    assert not own._progress.safe
    final, checked = own._progress.policy, [70.0, np.inf]  # before, and in an exploration
    few = np.zeros((1, SENSORS)), np.zeros((0, N_A))
    own._context = replace(
        own._context, measured=[Record(own._none, cost, *few) for cost in checked]
    )
    known, costs = [34.0, 47.0, 103.0, 47.0, 93.0, 113.0], [55.0, 52.0, 48.0]
    for law, every in ((own._none, known), (final, costs)):
        for cost in every:
            own._records.add(law, replace(result, cost=cost), set())
    own._judge(row)
    assert row["chosen"] == "adapted"
    assert row["predicted_change"] == pytest.approx(np.mean(costs) - np.mean([*known, 70.0]))


def test_a_law_that_measured_better_than_the_last_one_is_kept() -> None:
    better, *_ = told()
    own = optimiser(rollouts=7, judging=3, first=better.policy)
    own.tell([measured(asked) for asked in own.ask()])
    before, final = own._first + 1e-6, own._first + 2e-6
    own._progress.policy = final
    asked = [Rollout(law, seed) for law in (before, final) for seed in (1, 2, 3)]
    results = [measured(each) for each in asked]
    for more, best in ((0.1, final), (10.0, before)):
        again, row = copy.deepcopy(own), {}
        for each, result in zip(asked, results, strict=True):
            # That of the first law on the same field, or of one that runs away.
            known = again._records.all()[int(each.field_seed) - 1].cost
            cost = known * (more if np.array_equal(each.policy, final) else 0.1)
            again._records.add(each.policy, replace(result, cost=cost), set())
        again._judge(row)
        assert same_bits(again.policy, best) and row["chosen"] == "adapted"


def test_an_equation_that_the_first_rollouts_did_not_determine_is_looked_for_again() -> None:
    attempts = []

    def late(*given: Any) -> tuple[SensedModel, float] | None:
        attempts.append(given)
        return None if len(attempts) <= 3 else sensed_from(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_based_sensed, "sensed_from", late)
        own, models = optimiser(rollouts=7), []
        while not own.done:
            row = own.tell([measured(asked) for asked in own.ask()])
            models.append(row.get("model"))
    assert models[2] == "innovations" and models[3] == "sensed"


@pytest.mark.parametrize("far", [1.0, 100.0])
def test_no_control_follows_a_law_that_runs_away_before_an_equation_is_found(far: float) -> None:
    """Its rollouts show none; those of a law that stays near may."""
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
        assert ("no control follows" in str(row.get("reason"))) is runs_away
        assert all(asked.policy.any() is not np.bool_(runs_away) for asked in own.ask())


def test_readings_of_no_ring_get_a_model_of_the_readings_alone() -> None:
    _, context = small()
    other = Context(**{**vars(context), "periodic": False})
    assert ModelBased.for_context(other) is ModelBasedReadings


def test_a_rollout_that_ended_early_begins_where_its_first_readings_say() -> None:
    loop = loop_of(model_with(CUBIC, 0.0))
    readings = np.vstack(
        [np.cos(2 * np.pi * np.arange(SENSORS) / SENSORS), np.full(SENSORS, np.nan)]
    )
    lost = Record(np.zeros(1), np.inf, readings, np.zeros((1, N_A)))
    assert same_bits(loop.beginnings([lost])[0], interpolated(readings[0]))


def test_a_change_is_that_of_the_fields_from_which_both_laws_are_finite() -> None:
    change = gained(np.array([1.0, np.inf, 3.0]), np.array([2.0, np.inf, 5.0]))
    assert change.value == -1.5 and change.error == pytest.approx(0.5)
    assert np.isnan(gained(np.array([np.inf]), np.array([1.0])).value)
