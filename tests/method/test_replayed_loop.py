# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer on a model of few readings: replays, gradient, and what decides."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pdeloop.messages.cost import Cost
from pdeloop.method.adapt import Context, ModelBased, Record, RolloutResult, Trajectory
from pdeloop.method.adapt.belief import believe
from pdeloop.method.adapt.closed_loop import ReplayedLoop
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.model_based_sensed import ModelBasedReadings
from pdeloop.method.adapt.verdict import (
    ADAPTED,
    FIRST,
    Replays,
    evidence_of_rollouts,
    mean_of,
)
from pdeloop.method.design.lqg import law_of_innovations
from pdeloop.method.laws import Observer
from pdeloop.method.models.base import model_of
from pdeloop.method.models.linear import ReadingsModel
from pdeloop.method.reduce.subspace import subspace_model

N, N_Y, N_A, T, SIGMA, ORDER = 5, 2, 2, 40, 0.1, 5
RNG = np.random.default_rng(11)
A = RNG.standard_normal((N, N))
A *= 0.98 / np.abs(np.linalg.eigvals(A)).max()
B = RNG.standard_normal((N, N_A)) * [1.0, 0.2]  # unequal actuators
C = RNG.standard_normal((N_Y, N))
TARGET = np.array([0.5, -0.5])


def rolled(seed: int, law: Observer | None = None, theta: np.ndarray | None = None) -> Record:
    """Readings of the plant from a random state, excited where there is no law."""
    rng = np.random.default_rng(seed)
    x, y, actions, cost = rng.standard_normal(N), [], [], 0.0
    memory = np.zeros(0) if law is None else law.memory_start()
    for k in range(T + 1):
        y.append(C @ x + SIGMA * rng.standard_normal(N_Y))
        if k == T:
            break
        a = 0.5 * rng.standard_normal(N_A)
        if law is not None and theta is not None:
            parts = law.parts(theta)
            a = law.action(parts, y[-1], memory, k)
            memory = law.memory_update(parts, y[-1], memory, a, k)
        cost += float(np.sum((y[-1] - TARGET) ** 2) + 0.3 * np.sum(a**2)) / T
        actions.append(a)
        x = A @ x + B @ a + 0.02 * rng.standard_normal(N)
    policy = np.zeros(1) if theta is None else theta
    return Record(policy, cost, np.array(y), np.array(actions))


@cache
def explored() -> list[Record]:
    return [rolled(seed) for seed in range(70, 74)]


@cache
def first_law() -> Observer:
    model = subspace_model([(r.states, r.actions) for r in explored()], order=ORDER)
    cost = Cost(len(TARGET), model.B.shape[1], T, action_weight=0.3, target=TARGET)
    return Observer(law_of_innovations(model, TARGET, cost), T)


def context(**others: object) -> Context:
    law = first_law()
    first, *further = (Trajectory(r.states, r.actions) for r in explored())
    given = {"further": further, "noise": SIGMA, "law": law, "sensors": N_Y, "periodic": False}
    given |= others
    return Context(law.model.U, TARGET, 1.0, 0.3, T, first, **given)


@cache
def loop_and_rollout() -> tuple[ReplayedLoop, Record, np.ndarray]:
    law = first_law()
    theta = law.theta_start
    theta = theta + 0.05 * np.random.default_rng(3).standard_normal(theta.size)
    record = rolled(5, law, theta)
    belief = believe(context(), [*explored(), record], 0.05)
    assert belief is not None
    loop = belief.loop(context())
    assert isinstance(loop, ReplayedLoop)
    return loop, record, theta


def test_a_rollout_that_is_replayed_under_its_own_law_is_itself() -> None:
    loop, record, theta = loop_and_rollout()
    fields = loop.beginnings([record])
    found = loop.simulate(loop.theta(theta), fields)
    np.testing.assert_allclose(found.actions[:, 0], record.actions, atol=1e-9)
    assert found.costs[0] == pytest.approx(record.cost)
    # A shorter one is, as far as it goes.
    short = Record(theta, np.inf, record.states[:11], record.actions[:10])
    begun = loop.simulate(loop.theta(theta), loop.beginnings([short]))
    assert begun.actions[:5, 0] == pytest.approx(record.actions[:5], abs=0.1)


def test_the_state_that_a_rollout_began_with_is_the_likeliest_one() -> None:
    loop, record, _ = loop_and_rollout()
    model = loop.model
    assert isinstance(model, ReadingsModel)
    readings = record.states[:-1] @ model.U

    def unlikely(x: np.ndarray) -> float:
        """Minus twice the logarithm of the likelihood of x_0 and the readings, but for a constant."""
        total = float(x @ x)
        for v, a in zip(readings, record.actions, strict=True):
            e = v - model.C @ x
            total += float(e @ np.linalg.solve(model.innovations, e))
            x = model.A @ x + model.B @ a + model.G @ e
        return total

    first, innovations = model.replay(record.states, record.actions)
    assert innovations.shape == readings.shape
    least = unlikely(first)
    assert all(unlikely(first + d) > least for d in 0.01 * RNG.standard_normal((20, len(first))))
    again = model_of(model.arrays())
    assert isinstance(again, ReadingsModel) and np.array_equal(again.G, model.G)


@pytest.mark.parametrize("moving", [False, True])
def test_the_gradient_agrees_with_differences(moving: bool) -> None:
    loop, record, theta = loop_and_rollout()
    if moving:  # b and c for each step
        law = Observer(first_law().model, T)
        law.cost = Cost(N_Y, N_A, T, target=np.cos(np.arange(T * N_Y)).reshape(T, N_Y))
        own = replace(context(law=law), cost=law.cost)
        belief = believe(own, explored(), 0.05)
        assert belief is not None
        loop, theta = belief.loop(own), law.theta_start
        assert np.array_equal(loop.policy(loop.theta(theta), theta), theta)
    fields, weights = loop.beginnings([record, *explored()[:2]]), np.array([0.5, 0.2, 0.3])
    Theta = loop.theta(theta)
    value, gradient = loop.gradient(Theta, fields, weights)
    assert value == pytest.approx(weights @ loop.costs(Theta, fields))
    for direction in RNG.standard_normal((3, *Theta.shape)):
        step = 1e-6 * direction
        up, down = (weights @ loop.costs(Theta + s, fields) for s in (step, -step))
        assert np.sum(gradient * direction) == pytest.approx((up - down) / 2e-6, rel=1e-4)


def test_an_exact_model_tells_laws_apart_in_the_same_rollouts() -> None:
    """One that is wrong by as much as costs vary does not: measured costs decide."""
    loop, _, theta = loop_and_rollout()
    first = first_law().theta_start
    records = [rolled(20 + i, first_law(), law) for i in range(3) for law in (first, theta)]
    fields, laws = loop.beginnings(records), {FIRST: first, ADAPTED: theta}
    exact, wrong = (
        evidence_of_rollouts(laws, FIRST, records, Replays(loop, fields, error))[ADAPTED].change
        for error in (0.0, 1e4)
    )
    own, before = (loop.costs(loop.theta(law), fields) for law in (theta, first))
    on_model = mean_of(own - before)
    measured = evidence_of_rollouts(laws, FIRST, records)[ADAPTED].change
    assert exact == on_model and on_model.error < measured.error
    assert wrong == measured


def test_model_based_improves_a_law_of_few_readings_and_goes_on_with_the_same_bits() -> None:
    law = first_law()
    start, few = 0.4 * law.theta_start, ModelBasedSettings(iterations=8)

    def made() -> ModelBased:
        kind = ModelBased.for_context(context())
        assert kind is ModelBasedReadings
        return kind(start, seed=3, rollouts=9, settings=few, context=context())

    def told(optimizer: ModelBased) -> dict[str, object]:
        found = [rolled(r.field_seed, law, r.policy) for r in optimizer.ask()]
        return optimizer.tell(
            [RolloutResult(r.cost, False, Trajectory(r.states, r.actions)) for r in found]
        )

    optimizer = made()
    row = told(optimizer)
    assert row["model"] == "innovations" and 0.0 < float(str(row["mismatch"])) < 1.0
    while not optimizer.done:
        state = optimizer.state()
        row = told(optimizer)
    again = made()
    again.restore(state)
    assert told(again) == row
    assert np.array_equal(again.policy, optimizer.policy)
    assert row["chosen"] == ADAPTED
    before, after = (
        np.mean([rolled(10**6 + i, law, theta).cost for i in range(40)])
        for theta in (start, optimizer.policy)
    )
    assert after < 0.95 * before
