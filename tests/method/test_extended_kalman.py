# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The extended Kalman filter of a field between sensors, and the law on its estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdeloop.messages.action_set import ActionSet
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.sensed_loop import (
    UNPREDICTED,
    estimated_laws,
    least_trusting,
    noise_of_filter,
    whole_field_law,
)
from pdeloop.method.laws import ExtendedKalman, Observer
from pdeloop.method.laws.base import differentiable
from pdeloop.method.laws.registry import MAX_NUMBER, action, along
from pdeloop.method.models.base import DEFAULTS
from pdeloop.method.models.sensed import (
    WAVES,
    SensedFilter,
    field_of,
)
from tests.support.estimated import (
    CUBIC,
    LINEAR,
    N_A,
    SEEN,
    SENSORS,
    SIGMA,
    SPREAD,
    T,
    fields,
    filter_of,
    loop_of,
)
from tests.support.small import same_bits


def test_of_a_linear_equation_it_is_the_kalman_filter() -> None:
    rng = np.random.default_rng(1)
    mean, factor = rng.standard_normal(SPREAD.size), SPREAD * rng.standard_normal(2 * [SPREAD.size])
    known = SensedFilter(LINEAR, mean, factor, SIGMA)
    A, B = LINEAR.linearise(np.zeros(64), np.zeros(N_A))
    H = np.eye(64)[SEEN]
    first = field_of(factor, 64)
    x, P = field_of(mean, 64), first.T @ first
    own, S = (np.repeat(part[None], 2, axis=0) for part in known.start)
    for _ in range(6):
        y, a = rng.standard_normal(SENSORS), rng.standard_normal(N_A)
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + SIGMA**2 * np.eye(SENSORS))
        x, P = x + gain @ (y - H @ x), P - gain @ H @ P
        own, S = known.measured(own, S, np.stack([y, 3.0 * y]))
        np.testing.assert_allclose(own[0], x, atol=1e-8)
        np.testing.assert_allclose(S[0].T @ S[0], P, atol=1e-8)
        x, P = A @ x + B @ a, A @ P @ A.T
        own, S = known.predicted(own, S, np.stack([a, a]))


def test_it_finds_a_field_that_no_reading_shows() -> None:
    """It begins with waves that are zero at every sensor, and runs past them."""
    x = np.arange(64) / 64
    z = np.sin(2 * np.pi * 4 * (x - 1 / 16))[None]
    assert np.abs(z[0, SEEN]).max() < 1e-12
    spread = np.zeros_like(SPREAD)
    spread[[4, 4 + WAVES]] = 1.0
    known = filter_of(LINEAR, 1e-3, factor=np.diag(spread))
    own, S = (part[None] for part in known.start)
    for k in range(T):
        own, S = known.measured(own, S, z[:, SEEN])
        assert k or np.linalg.norm(own - z) > 0.9 * np.linalg.norm(z)
        none = np.zeros((1, N_A))
        z, (own, S) = LINEAR.step(z, none), known.predicted(own, S, none)
    assert np.linalg.norm(own - z) < 0.01 * np.linalg.norm(z)


def test_what_overflows_in_one_environment_leaves_the_other_alone() -> None:
    known = filter_of(CUBIC)
    x, S = (np.repeat(part[None], 2, axis=0) for part in known.start)
    y = np.stack([np.full(SENSORS, np.inf), np.ones(SENSORS)])
    with np.errstate(invalid="ignore"):
        both, _ = known.measured(x, S, y)
    alone, _ = known.measured(x[1:], S[1:], y[1:])
    assert np.isnan(both[0]).all()
    np.testing.assert_allclose(both[1], alone[0], rtol=1e-12)


def test_it_has_no_derivative_to_be_trained_with() -> None:
    assert differentiable(Observer) and not differentiable(ExtendedKalman)


@pytest.mark.parametrize("limit", [0.0, 0.2])
def test_its_simulation_is_what_the_law_does_on_the_model(limit: float) -> None:
    loop, law = loop_of(replace(CUBIC, noise=0.0))
    loop = replace(loop, action_set=ActionSet(limit=limit))
    theta = law.theta_of(
        0.05 * np.random.default_rng(5).standard_normal((N_A, 64)),
        np.full(N_A, 0.1),
        filter_of(CUBIC),
        DEFAULTS,
    )
    assert law.estimates(theta) and loop.theta(theta).ndim == 1
    found = loop.simulate(theta, fields(3))
    for m in range(3):
        z, a = found.states[:, m], found.actions[:, m]
        expected = along(law, theta, z[:-1, SEEN], a)
        if limit:
            expected = np.clip(expected, -limit, limit)
            assert (np.abs(a) == limit).any() and (np.abs(a) < limit).any()
        np.testing.assert_allclose(a, expected, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(z[1:], CUBIC.step(z[:-1], a), rtol=1e-7, atol=1e-9)
        q, r = loop.cost.size
        cost = np.mean(q * np.sum(z[:-1] ** 2, axis=1) + r * np.sum(a**2, axis=1))
        assert found.costs[m] == pytest.approx(cost)


def test_an_equation_that_cannot_be_integrated_is_a_law_that_diverges() -> None:
    loop, law = loop_of(CUBIC)
    theta = law.theta_of(np.ones((N_A, 64)), np.zeros(N_A), filter_of(CUBIC), DEFAULTS)
    parts = dict(law.parts(theta))
    parts["integration"] = np.zeros(4)  # internal steps without a reach
    assert law.filter(parts) is None
    a = action(law, parts, np.ones(SENSORS), law.memory_start(), 0)
    assert (a == MAX_NUMBER).all()
    assert law.memory_update(parts, np.ones(SENSORS), law.memory_start(), a, 0).shape == (
        law.memory_size,
    )
    assert np.isinf(loop.costs(law.vector(parts), fields(2))).all()


def test_the_designed_law_costs_little_more_than_that_of_the_whole_field() -> None:
    loop, _ = loop_of(CUBIC)
    every, weights = fields(24), np.full(24, 1.0 / 24.0)
    settings = ModelBasedSettings(iterations=30, filter_unpredicted=0.0)
    laws, steps = estimated_laws(loop, every, weights, settings)
    assert len(laws) == 2 and steps > 0
    others, equal = fields(20, seed=1), np.full(20, 1.0 / 20.0)
    none = loop.costs(loop.no_control, others) @ equal
    own = [loop.costs(theta, others) @ equal for theta in laws]
    found = whole_field_law(loop, every, weights, settings)
    assert found is not None
    whole, law = found
    best = whole.costs(law.theta, others) @ equal
    assert best < 0.9 * none
    assert max(own) - best < 0.1 * (none - best)


def test_a_filter_trusts_the_equation_less_where_the_law_costs_hardly_more() -> None:
    loop, law = loop_of(CUBIC)
    every, weights, trusted = fields(8), np.full(8, 1.0 / 8.0), 0.3
    settings = ModelBasedSettings(iterations=10, filter_unpredicted=trusted)
    designed, _ = estimated_laws(loop, every, weights, settings)
    best = min(designed, key=lambda theta: float(loop.costs(theta, every).mean()))
    parts = dict(law.parts(best))

    def theta_with(times: float) -> np.ndarray:
        noise = noise_of_filter(CUBIC, settings, times)
        return law.vector(parts | {"noise": np.array([noise])})

    assert same_bits(theta_with(1.0), best)
    others = [theta_with(times) for times in UNPREDICTED]
    known, *costs = (loop.costs(theta, every).mean() for theta in (best, *others))
    shares = [cost / known - 1.0 for cost in costs]
    assert shares[0] > shares[1] > 0.0, "costs rise with the noise of the filter"
    for allowed, expected in (
        (1.01 * shares[0], others[0]),
        (0.99 * shares[0], others[1]),
        (0.99 * shares[1], best),
    ):
        settings = replace(settings, filter_margin=allowed)
        assert same_bits(least_trusting(loop, best, every, settings), expected)
    lost = law.vector(parts | {"K_e": np.full((N_A, 64), np.inf)})
    assert least_trusting(loop, lost, every, settings) is lost
