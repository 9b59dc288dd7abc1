# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law on a model: its cost and gradient, the fields it is improved on, and a known optimum."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.cost import Cost
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.adapt.improve import (
    CONFIRMED,
    ModelBasedSettings,
    Renewal,
    averaged_over_shifts,
    curvature_of,
    improve,
    invariant_share,
    mixtures,
    own_gain,
    renew,
)
from pdeloop.method.design.lqt import track
from pdeloop.method.models.linear import LinearModel
from pdeloop.method.models.spectral import SpectralModel
from pdeloop.method.reduce.reduced_model import ReducedModel
from tests.method.test_plans import general_cost

N_Z, N_S, N_A, T = 16, 5, 2, 12


def bent() -> SpectralModel:
    """A plant with squares and cubes."""
    rng = np.random.default_rng(0)
    k = 1j * np.arange(N_Z // 2 + 1)
    return SpectralModel(
        kind="poly3",
        linear=0.2 * k + 0.02 * k**2,
        multipliers=np.array([0.05 * k, 0.1 + 0.0 * k]),
        polynomials=np.array([[0.5, 0.0], [0.2, -0.4]]),
        B=0.3 * rng.normal(size=(N_Z, N_A)),
        constant=0.1 * rng.normal(size=N_Z),
        substeps=2,
    )


def loop(limit: float = 0.0) -> ClosedLoop:
    rng = np.random.default_rng(1)
    U = np.linalg.qr(rng.normal(size=(N_Z, N_S)))[0]
    cost = Cost(N_Z, N_A, T, state_weight=1.5, action_weight=0.4, target=rng.normal(size=N_Z))
    return ClosedLoop(U, cost, ActionSet(limit=limit), model=bent())


def fields(count: int) -> np.ndarray:
    return np.random.default_rng(2).normal(size=(count, N_Z))


@pytest.mark.parametrize(
    ("admissible", "others"),
    [
        (ANY_ACTION, {}),
        (ActionSet(limit=0.4), {}),
        (ActionSet(low=-0.1), {}),
        (ActionSet(N_A, -0.5, 0.3, zero_mean=True), {}),
        (ActionSet(N_A, -0.5, 0.3, rate=0.2), {}),
        (ActionSet(N_A, -0.5, 0.3, zero_mean=True, rate=[0.2, 0.1]), {}),
        (ANY_ACTION, {"noise": 0.3}),
        (ANY_ACTION, {"cost": general_cost(T)}),
    ],
)
def test_the_gradient_is_that_of_finite_differences(
    admissible: ActionSet, others: dict[str, Any]
) -> None:
    closed = replace(loop(), action_set=admissible, **others)
    start, weights = fields(3), np.array([0.5, 0.2, 0.3])
    theta = 0.3 * np.random.default_rng(3).normal(size=(N_A, N_S + 1))
    cost, gradient = closed.gradient(theta, start, weights)
    assert cost == pytest.approx(weights @ closed.costs(theta, start), rel=1e-14)
    actions = closed.simulate(theta, start).actions
    saturated = admissible.held_back(actions)
    assert saturated.any() == admissible.bounded and not saturated.all()
    np.testing.assert_array_equal(admissible.applied(actions), actions)
    h, finite = 1e-6, np.zeros_like(theta)
    for index in np.ndindex(theta.shape):
        step = np.zeros_like(theta)
        step[index] = h
        rise = closed.costs(theta + step, start) - closed.costs(theta - step, start)
        finite[index] = weights @ rise / (2.0 * h)
    np.testing.assert_allclose(gradient, finite, rtol=1e-6, atol=1e-7)


@dataclass(frozen=True, eq=False)
class Fragile:
    """A model that breaks down from fields above 10."""

    model: SpectralModel

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        after = self.model.step(states, actions)
        after[np.abs(states).max(axis=1) > 10.0] = np.nan
        return after

    def __getattr__(self, name: str):  # type: ignore[no-untyped-def]
        return getattr(self.model, name)


def test_what_is_not_finite_is_left_out_and_changes_no_other_field() -> None:
    whole = loop()
    fragile = replace(whole, model=Fragile(bent()))
    start = np.concatenate([fields(2), np.full((1, N_Z), 11.0)])
    theta = np.full((N_A, N_S + 1), 0.1)
    costs = fragile.costs(theta, start)
    np.testing.assert_array_equal(costs[:2], fragile.costs(theta, start[:2]))
    np.testing.assert_allclose(costs[:2], whole.costs(theta, start[:2]), rtol=1e-12)
    assert np.isinf(costs[2])
    cost, gradient = fragile.gradient(theta, start, np.full(3, 1 / 3))
    assert np.isinf(cost) and not gradient.any()
    cost, gradient = fragile.gradient(theta, start, np.array([0.5, 0.5, 0.0]))
    expected = whole.gradient(theta, start[:2], np.full(2, 0.5))
    assert cost == pytest.approx(expected[0], rel=1e-12)
    np.testing.assert_allclose(gradient, expected[1], rtol=1e-12)
    arguments = np.eye(N_A), ModelBasedSettings()
    found = improve(fragile, theta, start, np.full(3, 1 / 3), *arguments)
    alone = improve(whole, theta, start[:2], np.full(2, 0.5), *arguments)
    assert found is not None and alone is not None and found.after < found.before
    assert found.after == pytest.approx(alone.after, rel=1e-3)
    assert improve(fragile, theta, start[2:], np.ones(1), *arguments) is None


def test_an_overflowing_law_is_halved_until_it_is_finite() -> None:
    closed, weights = loop(), np.full(3, 1 / 3)
    found = improve(
        closed, np.full((N_A, N_S + 1), 1e3), fields(3), weights, np.eye(N_A), ModelBasedSettings()
    )
    assert found is not None and np.isfinite(found.theta).all()
    assert np.isinf(closed.costs(np.full((N_A, N_S + 1), 1e3), fields(3))).all()
    assert found.after < 0.5 * found.before


def test_the_riccati_law_of_a_linear_plant_is_reached() -> None:
    """Over a long horizon the law of the algebraic Riccati equation is optimal from every field."""
    rng = np.random.default_rng(5)
    A, B = rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    A *= 1.05 / np.abs(np.linalg.eigvals(A)).max()
    target = np.array([0.5, -0.2, 0.3, 0.1])
    best = track(ReducedModel(A=A, B=B, U=np.eye(4)), state_weight=2.0, action_weight=0.1).policy
    model = LinearModel("linear", A, B, np.zeros(4))
    cost = Cost(4, 2, 200, state_weight=2.0, action_weight=0.1, target=target)
    closed = ClosedLoop(np.eye(4), cost, model=model)
    start, weights = rng.normal(size=(6, 4)), np.full(6, 1 / 6)
    steady = ModelBasedSettings(iterations=200, least_gain=1e-10)
    riccati = closed.theta(best)
    found = improve(closed, 0.6 * riccati, start, weights, np.eye(2), steady)
    assert found is not None
    cost = float(weights @ closed.costs(riccati, start))
    assert found.before > 1.03 * cost
    assert found.after == pytest.approx(cost, rel=1e-3)
    # The fields' transients are a small part of 200 steps, and so is what they say of the gains.
    np.testing.assert_allclose(found.theta, riccati, atol=0.05)


def test_the_less_a_law_is_trusted_to_move_the_less_it_does() -> None:
    closed, start, first = loop(), fields(3), np.full((N_A, N_S + 1), 0.1)
    weights, settings = np.full(3, 1 / 3), ModelBasedSettings(least_gain=1e-6)
    found = [
        improve(closed, first, start, weights, np.eye(N_A), settings, trust=trust)
        for trust in (0.0, 1.0, 10.0)
    ]
    moves = [np.linalg.norm(each.theta - first) for each in found if each is not None]
    costs = [each.after for each in found if each is not None]
    assert len(found) == len(moves) and moves[0] > 1.2 * moves[1] > 1.2 * moves[2] > 0.0
    assert costs[0] < costs[1] < costs[2] < found[0].before


def test_units_of_states_and_of_each_action_do_not_change_an_improvement() -> None:
    """mK, and kW beside kg/s: the curvature is that of the whole cost, and x has no unit."""
    A, B = 0.9 * np.eye(4) + 0.1 * np.eye(4, k=1), np.eye(4, 2)
    settings, target = ModelBasedSettings(iterations=4, least_gain=0.0), np.array([0.3, 0, 0, 0.1])
    found = []
    for scale, own in ((1.0, np.ones(2)), (1e3, np.array([1.0, 1e-3]))):
        Q, R = np.array([2.0, 1.0, 0.0, 0.5]) / scale**2, np.diag([0.4, 0.1]) / own**2
        cost = Cost(4, 2, T, state_weight=Q, action_weight=R, target=scale * target)
        model = LinearModel("linear", A, B * scale / own, np.zeros(4))
        closed = ClosedLoop(np.eye(4), cost, model=model)
        curvature = curvature_of(closed)
        start = scale * np.random.default_rng(4).normal(size=(6, 4))
        law = improve(closed, np.zeros((2, 5)), start, np.full(6, 1 / 6), curvature, settings)
        assert law is not None and law.after < law.before
        found.append(law.theta * np.append(np.full(4, scale), 1.0) / own[:, None])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-5, atol=1e-7)


def test_mixtures_have_the_mean_and_covariance_they_claim() -> None:
    rng = np.random.default_rng(6)
    measured = rng.normal(size=(4, 20)) * np.exp(-np.arange(20) / 3.0)
    drawn = mixtures(measured, 40, rng)
    assert 2 < len(drawn) <= 40
    mean, n = measured.mean(axis=0), len(measured)
    np.testing.assert_allclose(drawn.mean(axis=0), mean, atol=1e-12)
    rho, deviations = invariant_share(measured), measured - mean
    own = deviations.T @ deviations
    covariance = (1 - rho) * own + rho * averaged_over_shifts(deviations)
    covariance *= (1 + 1 / n) / (n - 1)
    found = (drawn - mean).T @ (drawn - mean) / len(drawn)
    assert np.trace(found) == pytest.approx(np.trace(covariance), rel=2e-2)
    np.testing.assert_allclose(found, covariance, atol=2e-2 * np.trace(covariance))
    assert 0.0 < rho < 1.0


def test_fields_between_walls_are_not_shifted() -> None:
    rng = np.random.default_rng(12)
    measured = np.zeros((5, 20))
    measured[:, :4] = rng.normal(size=(5, 4))
    assert mixtures(measured, 30, rng)[:, 4:].any()
    assert not mixtures(measured, 30, rng, periodic=False)[:, 4:].round(12).any()


def renewed(measured: np.ndarray, **constants: int) -> tuple[Renewal, float]:
    """The law made from a few fields, and its cost on many others."""
    closed = loop()
    none, settings = closed.no_control, ModelBasedSettings(mixtures=2, **constants)
    draw = partial(mixtures, rng=np.random.default_rng(6))
    found = renew(closed, none, none, [], measured, draw, settings)
    assert found is not None
    return found, float(closed.costs(found.theta, fields(100)).mean())


def test_a_law_that_asks_for_more_than_there_is_everywhere_is_improved() -> None:
    """All actions are at a bound from all fields, so that the gradient is 0; the target asks for 1."""
    A, B = 0.8 * np.eye(3), np.eye(3)[:, :2]
    model = LinearModel("linear", A, B, np.zeros(3))
    target = np.array([5.0, 5.0, 0.0])
    cost = Cost(3, 2, T, action_weight=1e-3, target=target)
    closed = ClosedLoop(np.eye(3), cost, ActionSet(2, 0.0, 3.0), model=model)
    first = np.column_stack([-0.1 * np.eye(2, 3), np.full(2, 40.0)])
    measured = np.random.default_rng(4).normal(size=(6, 3))
    assert (closed.simulate(first, measured).actions == 3.0).all()
    assert not closed.gradient(first, measured, np.full(6, 1 / 6))[1].any()
    draw = partial(mixtures, rng=np.random.default_rng(6))
    settings = ModelBasedSettings(mixtures=2, most_mixtures=2)
    found = renew(closed, first, first, [], measured, draw, settings)
    assert found is not None and found.fraction == 1.0 and found.change.is_negative(1.0)
    # The law that is best from every field: 3 until the target is there, and then 1.
    best = np.column_stack([-0.8 * np.eye(2, 3), np.full(2, 5.0)])
    own, least, before = (closed.costs(law, measured).mean() for law in (found.theta, best, first))
    assert least < 0.4 * before and own < 1.05 * least


def test_a_law_that_other_fields_do_not_confirm_is_made_again_on_more_draws() -> None:
    """The fields look alike everywhere, so that draws of their distribution tell what eight do not."""
    measured = np.random.default_rng(101).normal(size=(8, N_Z))
    few, cost = renewed(measured, most_mixtures=2)
    assert few.fraction == 0.0
    gain = own_gain(loop(), loop().no_control, few, measured)
    assert gain > 0.0 and -few.change.value < CONFIRMED * gain
    more, less = renewed(measured, most_mixtures=96)
    # Rounding, which differs from one processor to another, moves a descent on a chaotic plant.
    assert more.fraction > 0.0 and more.change.is_negative(1.0)
    assert less < 0.95 * cost and more.steps > few.steps


def test_a_law_that_other_fields_confirm_is_kept_to_the_bit() -> None:
    measured = np.random.default_rng(102).normal(size=(8, N_Z))
    (few, _), (more, _) = (renewed(measured, most_mixtures=most) for most in (2, 96))
    assert few.fraction > 0.0 and few.theta.tobytes() == more.theta.tobytes()
    assert -few.change.value >= CONFIRMED * own_gain(loop(), loop().no_control, few, measured)
