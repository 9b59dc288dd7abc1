# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer on a model: its cost, the gradient through its memory, and an improvement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.adapt import Context, ModelBased, RolloutResult, Trajectory
from pdeloop.method.adapt.closed_loop import ClosedLoop, LinearLoop
from pdeloop.method.adapt.improve import ModelBasedSettings, curvature_of, improve
from pdeloop.method.design.lqt import track
from pdeloop.method.laws import Observer
from pdeloop.method.laws.registry import along
from pdeloop.method.models.linear import LinearModel
from pdeloop.method.reduce.reduced_model import ReducedModel
from tests.support.small import same_bits

N_Z, N, N_A, T, LIMIT = 6, 3, 2, 12, 0.4
RNG = np.random.default_rng(5)
U = np.linalg.qr(RNG.standard_normal((N_Z, N)))[0]
PLANT = LinearModel(
    "linear",
    0.9 * np.linalg.qr(RNG.standard_normal((N_Z, N_Z)))[0],
    RNG.standard_normal((N_Z, N_A)),
    np.zeros(N_Z),
)
K_a, K_b = 0.3 * RNG.standard_normal((2, N_A, N))
TARGET = RNG.standard_normal(N_Z)
COST = Cost(N_Z, N_A, T, action_weight=0.5, target=TARGET)
ROWS = ModelRows(
    A=U.T @ PLANT.A @ U,
    B=U.T @ PLANT.B,
    U=U,
    K_a=K_a,
    K_b=K_b,
    s_r=U.T @ TARGET,
    L=0.6 * np.eye(N) + 0.1 * RNG.standard_normal((N, N)),
)
FIELDS = RNG.standard_normal((4, N_Z))
WEIGHTS = np.array([0.1, 0.4, 0.3, 0.2])


def loop_of(rows: ModelRows = ROWS, **others: object) -> LinearLoop:
    law = Observer(rows, T)
    given = {
        "cost": COST,
        "model": PLANT,
        "law": law,
        "noise": 0.2,
        "action_set": ActionSet(limit=LIMIT),
        **others,
    }
    return LinearLoop(rows.U, **given)


def some(loop: LinearLoop) -> np.ndarray:
    law = loop.law
    return loop.theta(law.theta_start + 0.1 * RNG.standard_normal(law.size))


def test_it_is_the_law_that_answers_with_its_memory_and_saturation() -> None:
    loop = loop_of(noise=0.0)
    theta = some(loop)
    found = loop.simulate(theta, FIELDS)
    assert (np.abs(found.actions) == LIMIT).any() and (np.abs(found.actions) < LIMIT).any()
    vector = loop.policy(theta, loop.law.theta_start)
    for f in range(len(FIELDS)):
        states, actions = found.states[:-1, f], found.actions[:, f]
        expected = np.clip(along(loop.law, vector, states, actions), -LIMIT, LIMIT)
        np.testing.assert_allclose(actions, expected, atol=1e-12)
        cost = np.sum((states - TARGET) ** 2) + 0.5 * np.sum(actions**2)
        assert found.costs[f] == pytest.approx(cost / T)


@pytest.mark.parametrize("limit", [0.0, LIMIT])
@pytest.mark.parametrize("any_cost", [False, True])
def test_the_gradient_agrees_with_differences(limit: float, any_cost: bool) -> None:
    cost = Cost(N_Z, N_A, T, state_weight=2.0, action_target=0.1, terminal_weight=3.0)
    loop = loop_of(action_set=ActionSet(limit=limit), cost=cost if any_cost else COST)
    theta = some(loop)
    value, gradient = loop.gradient(theta, FIELDS, WEIGHTS)
    assert value == pytest.approx(WEIGHTS @ loop.costs(theta, FIELDS))
    for direction in RNG.standard_normal((3, *theta.shape)):
        step = 1e-6 * direction
        up, down = (WEIGHTS @ loop.costs(theta + s, FIELDS) for s in (step, -step))
        assert np.sum(gradient * direction) == pytest.approx((up - down) / 2e-6, rel=1e-4)


def test_where_few_numbers_are_seen_memory_wins_over_the_best_static_law() -> None:
    """One number of six is seen, with noise; both laws are improved as far as they can be."""
    one = np.eye(N_Z, 1)
    seen = ModelRows(np.eye(1), one.T @ PLANT.B, one, K_a[:, :1], K_b[:, :1], one.T @ TARGET)
    fields, weights = RNG.standard_normal((24, N_Z)), np.full(24, 1 / 24)
    settings = ModelBasedSettings(least_gain=1e-4, iterations=200)
    own = {"model": PLANT, "noise": 0.3}
    static = ClosedLoop(one, COST, **own)
    law = Observer(seen, T)
    observed = LinearLoop(one, COST, **own, law=law)
    begun = static.theta(seen.policy)
    best = improve(static, begun, fields, weights, curvature_of(static), settings)
    begun = observed.theta(law.theta_start)
    found = improve(observed, begun, fields, weights, curvature_of(observed), settings)
    assert best is not None and found is not None
    assert found.after < 0.97 * best.after < best.before


STEPS, SIGMA = 30, 0.3


def rolled(law: Observer, theta: np.ndarray | None, seed: int) -> RolloutResult:
    """A rollout of the plant with measurement noise, explored where there is no theta."""
    rng, m = np.random.default_rng(seed), law.memory_start()
    z, states, actions, cost = rng.standard_normal(N_Z), [], [], 0.0
    for k in range(STEPS):
        seen = z + SIGMA * rng.standard_normal(N_Z)
        a = 0.3 * rng.standard_normal(N_A)
        if theta is not None:
            parts = law.parts(theta)
            a = law.action(parts, seen, m, k)
            m = law.memory_update(parts, seen, m, a, k)
        cost += (np.sum((z - TARGET) ** 2) + 0.5 * np.sum(a**2)) / STEPS
        states.append(seen)
        actions.append(a)
        z = PLANT.step(z[None], a[None])[0]
    states.append(z + SIGMA * rng.standard_normal(N_Z))
    return RolloutResult(float(cost), False, Trajectory(np.array(states), np.array(actions)))


def made(law: Observer, rollouts: int = 9) -> ModelBased:
    """From a law that is far from the best one."""
    first, second = (rolled(law, None, seed).trajectory for seed in (70, 71))
    assert first is not None and second is not None
    context = Context(
        U, TARGET, 1.0, 0.5, STEPS, first, further=[second], noise=SIGMA, law=law, periodic=False
    )
    few = ModelBasedSettings(iterations=30)
    start = 0.3 * law.theta_start
    return ModelBased(start, seed=3, rollouts=rollouts, settings=few, context=context)


def told(law: Observer, optimizer: ModelBased) -> dict[str, object]:
    asked = optimizer.ask()
    return optimizer.tell([rolled(law, r.policy, r.field_seed) for r in asked])


def test_model_based_improves_an_observer_law_and_continues_from_its_checkpoint() -> None:
    model = ReducedModel(ROWS.A, ROWS.B, U)
    gains = track(model, state_weight=1.0, action_weight=0.5)
    law = Observer(replace(ROWS, K_a=gains.K_a, K_b=gains.K_b), STEPS)
    optimizer = made(law)
    told(law, optimizer)
    again = made(law)
    again.restore(optimizer.state())
    row = told(law, optimizer)
    assert told(law, again) == row and same_bits(again.policy, optimizer.policy)
    assert (
        optimizer.done
        and row["chosen"] == "adapted"
        and optimizer.policy.shape == law.theta_start.shape
    )
    before, after = (
        np.mean([rolled(law, theta, 10**6 + i).cost for i in range(40)])
        for theta in (0.3 * law.theta_start, optimizer.policy)
    )
    assert after < 0.9 * before
