# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The law that plans from the estimate of a filter, between few sensors, and its training."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import pdeloop
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.cost import Cost
from pdeloop.messages.spec import ParameterError
from pdeloop.method.adapt import ModelBased, Rollout, RolloutResult, sensed_loop
from pdeloop.method.adapt.base import Optimizer
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.model_based_predictive import (
    ModelBasedPredictiveSensed,
)
from pdeloop.method.adapt.sensed_loop import from_estimates
from pdeloop.method.laws import ExtendedKalman
from pdeloop.method.laws.plans import Planner, planned, simulated
from pdeloop.method.laws.predictive import PredictiveKalman
from pdeloop.method.laws.registry import action, along, updated
from pdeloop.method.models.base import DEFAULTS
from pdeloop.method.models.sensed_fit import SENSED_REPRODUCED
from tests.support import sensed_optimiser
from tests.support.estimated import (
    CUBIC,
    N_A,
    SEEN,
    SENSORS,
    T,
    fields,
    filter_of,
    rows_of,
)
from tests.support.small import same_bits
from tuner_node.build import kind_of, law_of, remarks_on

Array = np.ndarray
RNG = np.random.default_rng(4)
K_E, B = 0.05 * RNG.standard_normal((N_A, 64)), np.full(N_A, 0.1)
FILTER = filter_of(CUBIC)
READINGS = RNG.standard_normal((6, SENSORS))


def made(allowed: ActionSet | None = None, steps: int = 5) -> tuple[PredictiveKalman, Array]:
    """A law, and its theta with plans of the cubic equation."""
    law = PredictiveKalman(rows_of(1.0), T)
    cost = Cost(64, N_A, T, state_weight=SENSORS / 64, action_weight=0.1, target=np.zeros(64))
    planner = Planner(
        CUBIC,
        cost,
        allowed or ActionSet(N_A, -0.3, 0.4),
        K_E,
        B,
        around=True,
        steps=steps,
        terminal=False,
        first=10,
        starts=2,
    )
    return law, law.theta_of(law.kalman.theta_of(K_E, B, FILTER, DEFAULTS), planner)


def test_without_plans_it_is_the_law_extended_kalman() -> None:
    law, _ = made()
    kalman, actions = ExtendedKalman(rows_of(1.0), T), RNG.standard_normal((6, N_A))
    assert same_bits(law.theta_start, kalman.theta_start)
    for theta in (kalman.theta_start, kalman.theta_of(K_E, B, FILTER, DEFAULTS)):
        expected = along(kalman, theta, READINGS, actions)
        assert expected.any()
        assert same_bits(along(law, theta, READINGS, actions), expected)
        assert not law.has_gains(theta) and not law.is_extended(theta)


@pytest.mark.parametrize("rate", [np.inf, 0.1])
def test_a_plan_starts_from_the_estimate_and_its_memory_is_that_of_the_episode(rate: float) -> None:
    allowed = ActionSet(N_A, -0.3, 0.4, rate=rate)
    law, theta = made(allowed)
    parts, memory = law.parts(theta), law.memory_start()
    planner, plan, a = law.planner(parts), np.zeros((1, 5, N_A)), None
    assert planner.action_set == allowed
    x, S = (part[None] for part in FILTER.start)
    for k, y in enumerate(READINGS):
        x, S = FILTER.measured(x, S, y[None])
        a, plan, _ = planner.step(plan, planner.after(x, a), k)
        plan = planner.shifted(plan)
        for asked in (law, made(allowed)[0]):  # another controller that is given the same states
            assert same_bits(action(asked, parts, y, memory, k), a[0])
        memory = updated(law, parts, y, memory, a[0], k)
        x, S = FILTER.predicted(x, S, a)
        assert memory.shape == (law.memory_size,)
        assert same_bits(law.kalman.prediction(memory[: law.kalman.memory_size]), x[0])
    assert np.abs(a).max() > 0.0


def test_its_simulation_is_what_the_law_does_on_the_model() -> None:
    law, theta = made()
    parts, starts = law.parts(theta), fields(2)
    planner, known = law.planner(parts), law.kalman.filter(parts)
    assert known is not None
    found, noisy = (
        simulated(planner, starts, from_estimates(planned(planner), known, sigma))[0]
        for sigma in (0.0, CUBIC.noise)
    )
    cost = planner.cost
    for z, expected in zip(starts, found, strict=True):
        memory, total = law.memory_start(), np.zeros(1)
        for k in range(T):
            a = action(law, parts, z[SEEN], memory, k)
            memory = updated(law, parts, z[SEEN], memory, a, k)
            cost.add(total, z[None], a[None], k)
            z = CUBIC.step(z[None], a[None])[0]
        assert total[0] / T == pytest.approx(expected, rel=1e-6)
    assert np.isfinite(noisy).all() and (noisy != found).all()


def test_plans_without_a_filter_are_refused() -> None:
    law, theta = made()
    parts = dict(law.parts(theta))
    for wrong in ({"K_e": np.zeros((N_A, 64))}, {"integration": np.zeros(4)}):
        with pytest.raises(ValueError, match="no filter whose estimates a plan could start from"):
            law.planner(parts | wrong)


class Small(PredictiveKalman):
    """Plans of an episode."""

    settings = replace(PredictiveKalman.settings, steps=10, first_iterations=10, starts=1)


class Eager(Small):
    """Keeps rollouts for plans as soon as a model promises any gain."""

    worth = 1e-9


def optimiser(kind: type[PredictiveKalman], rollouts: int) -> ModelBasedPredictiveSensed:
    _, context = sensed_optimiser.small()
    assert context.law is not None
    law = kind(context.law.model, context.horizon)
    context = replace(context, law=law)
    own = ModelBased.for_context(context)
    assert own is ModelBasedPredictiveSensed
    settings = ModelBasedSettings(iterations=5, mixtures=2, judging=2)
    return own(law.theta_start, seed=0, rollouts=rollouts, settings=settings, context=context)


def measured(own: Optimizer, asked: Rollout) -> RolloutResult:
    return sensed_optimiser.measured(asked, own._law)


@pytest.mark.parametrize("kind", [Small, Eager])
def test_an_optimiser_continues_from_its_state_and_judges_pairs(
    kind: type[PredictiveKalman],
) -> None:
    own, rows, asked = optimiser(kind, 9), list[dict[str, Any]](), list[Rollout]()
    judged = list[Rollout]()
    while not own.done:
        judged = own.ask()
        asked += judged
        rows.append(dict(own.tell([measured(own, rollout) for rollout in judged])))
        other = optimiser(kind, 9)
        other.restore(own.state())
        assert same_bits(other.policy, own.policy) and other.done == own.done
        for mine, its in zip(own.ask(), other.ask(), strict=True):
            assert same_bits(mine.policy, its.policy) and mine.field_seed == its.field_seed
    *_, before, last = rows
    assert any("could_save" in row for row in rows) == (kind is Eager)
    assert last["role"] == "judging" and "plan_saves" in before
    planned = [rollout for rollout in judged if own._law.is_extended(rollout.policy)]
    seeds = {rollout.field_seed for rollout in asked if not own._law.is_extended(rollout.policy)}
    assert len(planned) == 2 and {rollout.field_seed for rollout in planned} <= seeds
    assert own._law.is_extended(own.policy) == (last["chosen"] == "predictive")


def test_where_no_equation_reproduces_the_readings_the_law_stays_and_says_why(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """That fits of noise have such an error is shown by those of the fit."""
    poor = SimpleNamespace(error=1.1 * SENSED_REPRODUCED)
    monkeypatch.setattr(sensed_loop, "fit_sensed", lambda *_, **__: poor)
    own, rng, row = optimiser(Small, 6), np.random.default_rng(0), dict[str, Any]()
    while not own.done:
        results = []
        for rollout in own.ask():
            seen = measured(own, rollout).trajectory
            assert seen is not None
            mixed = rng.permutation(seen.states)
            results.append(RolloutResult(1.0, False, replace(seen, states=mixed)))
        row = dict(own.tell(results))
    why = "the law extended_kalman stays: no equation of the field reproduces the readings"
    assert why in row["reason"]


def test_a_law_that_plans_has_the_one_of_few_sensors_in_its_place() -> None:
    few = {"sensors": 8, "n_z": 64}
    for law, own in (("predictive", "predictive_kalman"), ("auto", "auto_kalman")):
        problem = pdeloop.problem("burgers", law=law, **few)
        assert problem.values["law"] == own and problem.values["identification"] == "subspace"
    with pytest.raises(ParameterError, match="but the whole state is measured; give --law predict"):
        pdeloop.train("burgers", law="predictive_kalman")
    with pytest.raises(ParameterError, match="plans from the whole state, but 8 sensors"):
        pdeloop.train("burgers", law="predictive", sensor_delays=2, **few)
    unequal, moving = (
        np.diag(np.arange(1.0, 65.0)),
        np.linspace(0.0, 1.0, 31)[:, None] * np.ones(64),
    )
    costs = {"target": moving}, {"state_weight": unequal}
    cases: list[tuple[str, dict[str, Any]]] = [
        ("on a periodic axis, between at most 32 sensors", {"sensors": 40, "n_z": 64}),
        *(("constant target and weights", {"cost": own, "horizon": 30, **few}) for own in costs),
    ]
    for why, how in cases:
        with pytest.raises(ParameterError, match=f"{why}.*; give --law extended_kalman"):
            pdeloop.train(pdeloop.problem("burgers", **how), law="predictive")
        told = remarks_on(pdeloop.problem("burgers", law="auto", **how).values)
        assert any(re.search(f"{why}.*, so extended_kalman is trained", own) for own in told)
    values = pdeloop.problem("burgers", law="auto", cost={"target": 0.5}, **few).values
    assert law_of(values, kind_of(values)).name == "auto_kalman"


class Rod(pdeloop.Dynamics):
    """A rod that two heaters warm, with weights that differ from place to place."""

    n_z, n_a, horizon, action_weight = 12, 2, 30, 0.1
    state_weight = np.diag(np.linspace(1.0, 2.0, 12))
    A = 0.4 * np.eye(12) + 0.29 * (np.eye(12, k=1) + np.eye(12, k=-1))
    B = np.eye(12)[:, [3, 8]]

    def initial_state(self, rng: np.random.Generator) -> Array:
        return rng.normal(1.0, 0.2, 12)

    def step(self, z: Array, a: Array) -> Array:
        return self.A @ z + self.B @ a


def test_where_nothing_can_be_planned_auto_trains_the_law_without_plans() -> None:
    how: dict[str, Any] = {"sensors": 4, "rollouts": 16, "evaluation_fields": 2}
    auto, plain = (
        pdeloop.train(plant=Rod(), law=law, **how) for law in ("auto", "extended_kalman")
    )
    assert plain.costs["adapted"].mean() < plain.costs["lqt"].mean() < plain.costs["none"].mean()
    for kind, costs in plain.costs.items():
        assert same_bits(auto.costs[kind], costs)
