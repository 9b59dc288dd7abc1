# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws with a constant part for each step on a model, and rollouts that a model repeats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.adapt import Record
from pdeloop.method.adapt.closed_loop import ClosedLoop, LinearLoop
from pdeloop.method.adapt.improve import ModelBasedSettings, curvature_of, improve, renew
from pdeloop.method.design.lqt import regulator, track_horizon
from pdeloop.method.laws.linear import FeedForward
from pdeloop.method.models.linear import LinearModel

N, N_A, T = 4, 2, 15
RNG = np.random.default_rng(7)
A = RNG.normal(size=(N, N))
A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
B, DRIFT = RNG.normal(size=(N, N_A)), 0.3 * RNG.normal(size=N)
TARGET = np.cumsum(0.2 * RNG.normal(size=(T, N)), axis=0)
COST = Cost(N, N_A, T, state_weight=np.diag([1.0, 2.0, 0.5, 1.0]), action_weight=0.3, target=TARGET)
MODEL = LinearModel("linear", A, B, DRIFT)


def loop(**changes: object) -> LinearLoop:
    gains = np.zeros((N_A, N))
    rows = ModelRows(A=A, B=B, U=np.eye(N), K_a=gains, K_b=gains, s_r=np.zeros(N))
    law = FeedForward(rows, T)
    law.cost = COST
    made = LinearLoop(np.eye(N), COST, model=MODEL, law=law)
    return replace(made, **changes)  # type: ignore[arg-type]


def fields(count: int) -> np.ndarray:
    return np.random.default_rng(8).normal(size=(count, N))


def test_the_gradient_is_that_of_finite_differences_also_with_bounds_and_replays() -> None:
    rng = np.random.default_rng(9)
    theta = 0.2 * rng.normal(size=(N_A, N + T))
    weights = np.array([0.6, 0.4])
    plain, bounded = loop(), loop(action_set=ActionSet(N_A, [-0.2, 0.0], [0.5, 0.4]))
    replays = np.hstack([fields(2), 0.1 * rng.normal(size=(2, N * T))])
    for closed, start in ((plain, fields(2)), (bounded, fields(2)), (plain, replays)):
        cost, gradient = closed.gradient(theta, start, weights)
        assert cost == pytest.approx(weights @ closed.costs(theta, start), rel=1e-13)
        step = rng.normal(size=theta.shape)
        rise = closed.costs(theta + 1e-6 * step, start) - closed.costs(theta - 1e-6 * step, start)
        assert np.sum(gradient * step) == pytest.approx(weights @ rise / 2e-6, rel=1e-5)
    assert (np.abs(bounded.simulate(theta, fields(2)).actions[:, :, 1] - 0.4) < 1e-15).any()


def test_the_descent_leads_to_the_tracking_law_of_one_initial_state() -> None:
    """From one state a feed-forward is as good as any controller: LQ tracking with the drift."""
    closed, start = loop(), fields(1)
    gains = track_horizon(A, B, COST, np.eye(N), DRIFT)
    z, best = start[0], np.zeros(1)
    for k in range(T):
        a = gains.K[k] @ z + gains.b[k]
        COST.add(best, z[None], a[None], k)
        z = A @ z + B @ a + DRIFT
    settings = ModelBasedSettings(iterations=300, least_gain=1e-9)
    begun = np.zeros((N_A, N + T))
    found = improve(closed, begun, start, np.ones(1), curvature_of(closed), settings)
    assert found is not None
    assert found.before > 1.5 * best[0] / T
    assert found.after == pytest.approx(best[0] / T, rel=1e-4)
    policy = closed.policy(found.theta, closed.law.theta_start)
    assert np.array_equal(closed.theta(policy), found.theta)


def test_a_law_without_gains_is_no_control_also_where_the_target_moves() -> None:
    """As is said where a training begins so: a model that gave no gains gives no offsets either."""
    still = loop().law
    assert isinstance(still, FeedForward) and not still.theta_start.any()
    gains = regulator(MODEL, COST)
    assert gains is not None
    found = FeedForward(replace(still.model, K_a=gains.K), T)
    found.cost = COST
    assert np.ptp(found.start()["b"], axis=0).min() > 0.1


@pytest.mark.parametrize(
    ("seed", "most", "saved"), [(1, 1.01, 0.05), (2, 1.02, 0.01), (6, 1.01, 0.05)]
)
def test_a_descent_begins_again_with_small_gains_where_actuators_are_slow(
    seed: int, most: float, saved: float
) -> None:
    """They follow none of the large ones, and no gradient tells so; the best moves are searched for."""
    rate, start = 0.2, np.random.default_rng(seed).normal(size=(1, N))
    closed = loop(action_set=ActionSet(N_A, rate=rate))
    assert closed.regulator is not None
    first = np.hstack([closed.regulator.K, np.tile(closed.regulator.b[:, None], T)])

    def cost(moves: np.ndarray) -> tuple[float, np.ndarray]:
        plan = np.hstack([np.zeros((N_A, N)), np.cumsum(moves.reshape(T, N_A), axis=0).T])
        known, slope = closed.gradient(plan, start, np.ones(1))
        return known, np.cumsum(slope[:, : N - 1 : -1], axis=1)[:, ::-1].T.ravel()

    bounds = [(-rate, rate)] * (T * N_A)
    best = minimize(cost, np.zeros(T * N_A), jac=True, bounds=bounds).fun
    alone = improve(closed, first, start, np.ones(1), curvature_of(closed), ModelBasedSettings())
    found = renew(closed, first, first, [], start, lambda own, most: own[:0], ModelBasedSettings())
    assert alone is not None and found is not None
    cost_of_it = float(closed.costs(found.theta, start)[0])
    assert cost_of_it < most * best
    assert cost_of_it < (1.0 - saved) * alone.after


def test_a_replayed_rollout_costs_what_was_measured_whatever_the_model() -> None:
    """Of a plant that bends, with a linear model; the law is the one that it was measured under."""
    rng = np.random.default_rng(10)
    cost = Cost(N, N_A, T, action_weight=0.4, target=1.0)
    closed = ClosedLoop(np.eye(N), cost, model=MODEL)
    theta = 0.2 * rng.normal(size=(N_A, N + 1))
    z, states, actions, total = rng.normal(size=N), [], [], 0.0
    for _ in range(T):
        a = theta[:, :N] @ z + theta[:, N]
        total += float(np.sum((z - 1.0) ** 2) + 0.4 * np.sum(a**2))
        states.append(z)
        actions.append(a)
        z = A @ z + B @ a + 0.3 * np.sin(3.0 * z) + 0.1 * rng.normal(size=N)
    record = Record(theta, total / T, np.array([*states, z]), np.array(actions))
    replayed = closed.replays_of([record])
    assert closed.costs(theta, replayed)[0] == pytest.approx(record.cost, rel=1e-12)
    assert closed.costs(theta, replayed[:, :N])[0] != pytest.approx(record.cost, rel=1e-2)
