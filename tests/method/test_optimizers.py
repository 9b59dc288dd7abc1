# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The two-point method: the paper's update and estimate, divergence, checkpoints, determinism."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest

from pdeloop.method.adapt import Optimizer, RolloutResult, TwoPoint
from pdeloop.method.adapt.two_point import TwoPointSettings, direction, gradient
from pdeloop.method.seeds import field_seed

SHAPE = (2, 6)
N_A, N_S = 2, 3
POLICY = np.random.default_rng(0).standard_normal(SHAPE)


def cost(policy: np.ndarray, field_seed: int) -> float:
    """A quadratic whose scale depends on the field."""
    return (1.0 + 0.2 * (field_seed % 7) / 7) * float(np.sum((policy - 0.3) ** 2)) + 1.0


def two_point(policy: np.ndarray = POLICY, **changes: Any) -> TwoPoint:
    constants = {"learning_rate": 1e-3, "smoothing_radius": 0.1}
    constants |= {name: changes.pop(name) for name in constants if name in changes}
    given = {"seed": 3, "rollouts": 24} | changes
    return TwoPoint(policy, **given, settings=TwoPointSettings(**constants))


def measure(optimizer: Optimizer) -> list[RolloutResult]:
    return [RolloutResult(cost(r.policy, r.field_seed)) for r in optimizer.ask()]


def test_two_point_is_the_papers_iteration() -> None:
    optimizer = two_point(smoothing_radius=0.2)
    policy = POLICY.copy()
    for k in range(12):
        theta, field = direction(3, k, SHAPE), field_seed(3, k)
        plus, minus = policy + 0.2 * theta, policy - 0.2 * theta
        asked = optimizer.ask()
        assert np.array_equal(asked[0].policy, plus)
        assert np.array_equal(asked[1].policy, minus)
        assert asked[0].field_seed == asked[1].field_seed == field
        difference = cost(plus, field) - cost(minus, field)
        policy = policy - 1e-3 * (N_A * N_S / 0.2 * difference * theta)
        row = optimizer.tell(measure(optimizer))
        np.testing.assert_array_equal(optimizer.policy, policy)
        assert row["cost_plus"] == cost(plus, field)
        assert row["cost_minus"] == cost(minus, field)
    assert optimizer.done
    assert np.array_equal(optimizer.policy, policy)


def test_ask_is_pure_and_rows_are_json() -> None:
    optimizer = two_point()
    total = 0
    while not optimizer.done:
        first, second = optimizer.ask(), optimizer.ask()
        for a, b in zip(first, second, strict=True):
            assert np.array_equal(a.policy, b.policy)
            assert a.field_seed == b.field_seed
        total += len(first)
        row = optimizer.tell(measure(optimizer))
        assert json.loads(json.dumps(row, allow_nan=False)) == row
        assert row["rollouts"] == total
        assert row["updated"] is True
    assert total == 24
    assert optimizer.ask() == []


def test_what_is_handed_out_cannot_change_the_optimiser() -> None:
    optimizer = two_point()
    optimizer.policy[:] = np.nan
    for rollout in optimizer.ask():
        rollout.policy[:] = np.nan
    optimizer.state()["policy"][:] = np.nan
    assert np.array_equal(optimizer.policy, POLICY)
    assert np.isfinite(optimizer.ask()[0].policy).all()


DIVERGED = [
    RolloutResult(np.nan, diverged=True),
    RolloutResult(1.0, diverged=True),
    RolloutResult(np.inf),
    RolloutResult(np.nan),
]


@pytest.mark.parametrize("bad", DIVERGED)
@pytest.mark.parametrize("place", [0, 1])
def test_a_diverged_rollout_stays_out_of_the_policy(bad: RolloutResult, place: int) -> None:
    optimizer = two_point()
    optimizer.tell(measure(optimizer))
    before = optimizer.policy
    results = measure(optimizer)
    results[place] = bad
    row = optimizer.tell(results)
    assert row["diverged"] == 1
    assert row["updated"] is False
    assert json.dumps(row, allow_nan=False)
    assert np.array_equal(optimizer.policy, before)
    halved = optimizer.tell(measure(optimizer))
    assert halved["learning_rate"] == 0.5 * float(row["learning_rate"])
    assert halved["updated"] is True
    assert optimizer.tell(measure(optimizer))["learning_rate"] == halved["learning_rate"]


def test_an_overflowing_step_stays_out_of_the_policy() -> None:
    optimizer = two_point(learning_rate=1e300)
    results = [RolloutResult(1e300 * (i + 1)) for i in range(len(optimizer.ask()))]
    row = optimizer.tell(results)
    assert row["updated"] is False
    assert json.dumps(row, allow_nan=False)
    assert np.array_equal(optimizer.policy, POLICY)


def through_file(optimizer: Optimizer) -> dict[str, np.ndarray]:
    buffer = io.BytesIO()
    np.savez(buffer, **optimizer.state())
    buffer.seek(0)
    with np.load(buffer, allow_pickle=False) as stored:
        return dict(stored)


def test_a_restored_training_ends_with_the_same_bits() -> None:
    def step(optimizer: Optimizer) -> dict[str, Any]:
        results = measure(optimizer)
        if optimizer.tells == 2:
            results[0] = RolloutResult(np.nan, diverged=True)
        return optimizer.tell(results)

    whole = two_point()
    while not whole.done:
        again = two_point()
        again.restore(through_file(whole))
        assert again.tells == whole.tells
        assert step(again) == step(whole)
        assert np.array_equal(again.policy, whole.policy)
        state, expected = again.state(), whole.state()
        assert all(np.array_equal(state[k], expected[k], equal_nan=True) for k in expected)


def test_refuses_a_foreign_checkpoint_and_stays_as_it_was() -> None:
    optimizer = two_point()
    with pytest.raises(ValueError, match="no array 'tells'"):
        optimizer.restore({"policy": POLICY})
    with pytest.raises(ValueError, match=r"got float64 and \(2, 4\)"):
        optimizer.restore(optimizer.state() | {"policy": POLICY[:, :4]})
    with pytest.raises(ValueError, match="finite"):
        optimizer.restore(optimizer.state() | {"policy": POLICY * np.nan})
    assert np.array_equal(optimizer.policy, POLICY)


def test_refuses_the_wrong_number_of_results() -> None:
    optimizer = two_point()
    with pytest.raises(ValueError, match="one result per rollout"):
        optimizer.tell(measure(optimizer)[:1])
    while not optimizer.done:
        optimizer.tell(measure(optimizer))
    with pytest.raises(ValueError, match="done"):
        optimizer.tell([])


@pytest.mark.parametrize("value", [0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize("name", ["learning_rate", "smoothing_radius", "rollouts"])
def test_refuses_bad_parameters(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        two_point(**{name: value})


def test_refuses_bad_policies() -> None:
    with pytest.raises(ValueError, match="must have parameters"):
        two_point(POLICY[:0])
    with pytest.raises(ValueError, match="must be finite"):
        two_point(POLICY * np.inf)


def test_it_knows_no_shape() -> None:
    """The parameters of any law are one vector."""
    matrix, vector = two_point(), two_point(POLICY.ravel())
    while not matrix.done:
        rows = [optimizer.tell(measure(optimizer)) for optimizer in (matrix, vector)]
        assert rows[0] == rows[1]
    assert vector.policy.tobytes() == matrix.policy.tobytes()


def test_directions_are_uniform_on_the_sphere() -> None:
    draws = np.array([direction(0, k, (3, 4)).ravel() for k in range(4000)])
    # E[d Theta Theta^T] = I; an entry of the mean has standard error below 1.5 / sqrt(4000).
    covariance = draws.shape[1] * draws.T @ draws / len(draws)
    np.testing.assert_allclose(covariance, np.eye(draws.shape[1]), atol=5 * 1.5 / np.sqrt(4000))
    assert np.abs(draws.mean(axis=0)).max() < 5 / np.sqrt(12 * 4000)


def test_field_seeds_fit_a_float_and_are_their_own_stream() -> None:
    seeds = [field_seed(1, k) for k in range(200)]
    assert len(set(seeds)) == 200 and max(seeds) > 2**50
    assert all(0 <= s < 2**53 and int(float(s)) == s for s in seeds)
    # Another user of the same seed, with a step instead of a stream, draws something else.
    assert field_seed(1, 0) != np.random.default_rng([1, 0]).integers(2**53)


def test_all_orthonormal_directions_give_the_gradient_of_a_quadratic_exactly() -> None:
    rng = np.random.default_rng(4)
    half, g, policy = (
        rng.standard_normal((12, 12)),
        rng.standard_normal(12),
        rng.standard_normal(12),
    )
    H, directions = half @ half.T, np.linalg.qr(rng.standard_normal((12, 12)))[0]

    def cost(x: np.ndarray) -> float:
        return float(g @ x + 0.5 * x @ H @ x)

    steps = [(cost(policy + 0.1 * t), cost(policy - 0.1 * t), t) for t in directions]
    mean = np.mean([gradient(*step, 0.1) for step in steps], axis=0)
    np.testing.assert_allclose(mean, g + H @ policy, rtol=1e-10, atol=1e-10)
