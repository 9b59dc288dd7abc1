# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Directions, seeds, and the two-point estimate against theory."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.adapt.two_point import direction, gradient
from pdeloop.method.seeds import field_seed

SHAPE = (3, 4)


def test_directions_have_unit_norm_and_are_pure() -> None:
    theta = direction(5, 7, SHAPE)
    assert theta.shape == SHAPE
    assert np.linalg.norm(theta) == pytest.approx(1.0, abs=1e-15)
    assert np.array_equal(theta, direction(5, 7, SHAPE))
    assert not np.array_equal(theta, direction(5, 8, SHAPE))
    assert not np.array_equal(theta, direction(6, 7, SHAPE))


def test_directions_are_uniform_on_the_sphere() -> None:
    draws = np.array([direction(0, k, SHAPE).ravel() for k in range(4000)])
    # E[d Theta Theta^T] = I; an entry of the mean has standard error below 1.5 / sqrt(4000).
    covariance = draws.shape[1] * draws.T @ draws / len(draws)
    np.testing.assert_allclose(covariance, np.eye(draws.shape[1]), atol=5 * 1.5 / np.sqrt(4000))
    assert np.abs(draws.mean(axis=0)).max() < 5 / np.sqrt(12 * 4000)


def test_field_seeds_fit_a_float_and_are_their_own_stream() -> None:
    seeds = [field_seed(1, k) for k in range(200)]
    assert len(set(seeds)) == 200
    assert all(0 <= s < 2**53 and int(float(s)) == s for s in seeds)
    assert max(seeds) > 2**50
    # Another user of the same seed, with a step instead of a stream, draws something else.
    shared = np.random.default_rng([1, 0]).integers(2**53)
    assert field_seed(1, 0) != shared


def quadratic(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    half = rng.standard_normal((12, 12))
    return half @ half.T, rng.standard_normal(12)


def test_all_orthonormal_directions_give_the_gradient_of_a_quadratic_exactly() -> None:
    H, g = quadratic(4)
    policy = np.random.default_rng(5).standard_normal(SHAPE)

    def cost(pi: np.ndarray) -> float:
        return float(g @ pi.ravel() + 0.5 * pi.ravel() @ H @ pi.ravel())

    directions = np.linalg.qr(np.random.default_rng(6).standard_normal((12, 12)))[0]
    directions = directions.reshape(12, *SHAPE)
    mean = sum(gradient(cost(policy + 0.1 * t), cost(policy - 0.1 * t), t, 0.1) for t in directions)
    exact = (g + H @ policy.ravel()).reshape(SHAPE)
    np.testing.assert_allclose(np.asarray(mean) / 12, exact, rtol=1e-10, atol=1e-10)
