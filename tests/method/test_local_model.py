# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fitted local models and the sensitivities along trajectories."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from loop_method.adapt.local_model import LocalModel, extended_basis, fit
from loop_method.adapt.local_step import (
    Comparison,
    choices,
    mismatches,
    predict_difference,
)
from loop_method.adapt.sensitivity import (
    ReducedTrajectory,
    damped_step,
    expand,
)
from loop_method.adapt.settings import GaussNewtonSettings
from loop_method.reduce.identifiability import NotIdentifiableError

R, N_A, N_S, STEPS = 4, 2, 3, 12
KAPPAS = GaussNewtonSettings().forgettings


def planted(seed: int = 0, bend: float = 0.1) -> LocalModel:
    rng = np.random.default_rng(seed)
    H = bend * rng.standard_normal((R, R, R))
    return LocalModel(
        centre=0.1 * rng.standard_normal(R),
        constant=0.05 * rng.standard_normal(R),
        linear=0.3 * rng.standard_normal((R, R)) - 0.3 * np.eye(R),
        B=rng.standard_normal((R, N_A)),
        quadratic=0.5 * (H + H.transpose(0, 2, 1)),
        cubic=np.zeros((R, 0, 0, 0)),
    )


def roll(
    model: LocalModel, theta: np.ndarray, x: np.ndarray, limit: float = np.inf
) -> ReducedTrajectory:
    """Closed loop a = K s + b of the model, with theta = [K b], saturated at +- limit."""
    states, actions = [], []
    for _ in range(STEPS):
        a = np.clip(theta @ np.append(x[:N_S], 1.0), -limit, limit)
        states.append(x)
        actions.append(a)
        x = model.step(x, a)
    s, applied = np.array(states), np.array(actions)
    free = None if limit == np.inf else (np.abs(applied) < limit).astype(float)
    features = np.column_stack([s[:, :N_S], np.ones(STEPS)])
    return ReducedTrajectory(s, applied, features, theta[:, :N_S], free)


THETA = 0.1 * np.random.default_rng(9).standard_normal((N_A, N_S + 1))
START = np.array([0.5, -0.3, 0.2, 0.4])
TARGET = np.array([0.1, 0.2, -0.1, 0.0])


def test_fit_recovers_a_planted_quadratic_system() -> None:
    model = planted()
    rng = np.random.default_rng(1)
    x, a = rng.standard_normal((3000, R)), rng.standard_normal((3000, N_A))
    # So many samples of unit spread that a ridge of 1e-8 and of 1e-5 biases by about as much.
    fitted = fit(x, a, model.step(x, a) - x, np.ones(3000), [1e-8])[0]
    np.testing.assert_allclose(fitted.step(x, a), model.step(x, a), atol=2e-4)
    np.testing.assert_allclose(fitted.jacobians(x), model.jacobians(x), atol=2e-4)
    np.testing.assert_allclose(fitted.B, model.B, atol=2e-4)
    np.testing.assert_allclose(fitted.quadratic, model.quadratic, atol=2e-4)


@pytest.mark.parametrize("units", [(1e-9, 1e9), (1e9, 1e-9), (1e-9, 1e-9), (1e9, 1e9)])
def test_fit_does_not_depend_on_the_units_of_the_inputs(units: tuple[float, float]) -> None:
    model, rng = planted(), np.random.default_rng(1)
    x, a = rng.standard_normal((300, R)), rng.standard_normal((300, N_A))
    change = model.step(x, a) - x
    for one, other in zip(
        fit(x, a, change, np.ones(300), [1e-6]),
        fit(x, a * units, change, np.ones(300), [1e-6]),
        strict=True,
    ):
        np.testing.assert_allclose(other.B * units, one.B, rtol=1e-9)
        np.testing.assert_allclose(other.linear, one.linear, atol=1e-9)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_fit_refuses_inputs_that_it_cannot_tell_apart(unit: float) -> None:
    model, rng = planted(), np.random.default_rng(1)
    x, a = rng.standard_normal((300, R)), rng.standard_normal((300, N_A))
    for own, words in (
        (a * [1.0, 0.0], "the input a2 never moved"),
        (np.c_[a[:, 0], 3.0 * a[:, 0]], "a1 and a2"),
        (np.c_[a[:, 0], 0.1 * x[:, 2] + 0.5], "the input a2 always followed from the state"),
    ):
        with pytest.raises(NotIdentifiableError, match=words):
            fit(x, unit * own, model.step(x, own) - x, np.ones(300), [1e-6])
        fit(x, unit * (own + 1e-3 * a), model.step(x, own) - x, np.ones(300), [1e-6])


def test_fit_recovers_a_planted_cubic_system_in_the_leading_modes() -> None:
    rng = np.random.default_rng(1)
    C = 0.05 * rng.standard_normal((R, 2, 2, 2))
    model = replace(planted(), cubic=sum(C.transpose(0, *o) for o in permutations((1, 2, 3))) / 6)
    x, a = rng.standard_normal((3000, R)), rng.standard_normal((3000, N_A))
    change = model.step(x, a) - x
    without, fitted = fit(x, a, change, np.ones(3000), [1e-8], leading=2)
    assert without.cubic.size == 0
    assert np.abs(without.step(x, a) - model.step(x, a)).max() > 0.1
    np.testing.assert_allclose(fitted.step(x, a), model.step(x, a), atol=2e-3)
    np.testing.assert_allclose(fitted.cubic, model.cubic, atol=2e-4)
    np.testing.assert_allclose(fitted.jacobians(x), model.jacobians(x), atol=2e-3)
    alone = fit(x, a, change, np.ones(3000), [1e-8])[0]
    np.testing.assert_allclose(without.quadratic, alone.quadratic, atol=1e-10)


def test_an_infinite_ridge_fits_an_affine_system() -> None:
    model = planted(bend=0.0)
    rng = np.random.default_rng(2)
    x, a = rng.standard_normal((500, R)), rng.standard_normal((500, N_A))
    affine, stiff = fit(x, a, model.step(x, a) - x, np.ones(500), [np.inf, 1e9])
    assert not affine.quadratic.any()
    np.testing.assert_allclose(affine.step(x, a), model.step(x, a), atol=1e-4)
    # A very large ridge tends to the same model.
    np.testing.assert_allclose(stiff.linear, affine.linear, atol=1e-6)


def test_weights_choose_between_two_systems() -> None:
    first, second = planted(0), planted(5)
    rng = np.random.default_rng(3)
    x, a = rng.standard_normal((2000, R)), rng.standard_normal((2000, N_A))
    change = np.concatenate([first.step(x, a)[:1000], second.step(x, a)[1000:]]) - x
    weights = np.r_[np.ones(1000), np.zeros(1000)]
    fitted = fit(x, a, change, weights, [1e-8])[0]
    np.testing.assert_allclose(fitted.B, first.B, atol=1e-3)


@pytest.mark.parametrize("leading", [0, 1, 3])
def test_jacobians_are_the_derivative_of_the_step(leading: int) -> None:
    C = np.random.default_rng(8).standard_normal((R, leading, leading, leading))
    symmetric = sum(C.transpose(0, *order) for order in permutations((1, 2, 3))) / 6
    model, a = replace(planted(), cubic=symmetric), np.zeros(N_A)
    jacobian = model.jacobians(START)
    h = 1e-6
    for j in range(R):
        e = h * np.eye(R)[j]
        difference = (model.step(START + e, a) - model.step(START - e, a)) / (2 * h)
        np.testing.assert_allclose(jacobian[:, j], difference, atol=1e-9)


def test_basis_is_orthonormal_begins_with_the_given_modes_and_spans_the_data() -> None:
    rng = np.random.default_rng(4)
    U = np.linalg.qr(rng.standard_normal((30, 3)))[0]
    states = rng.standard_normal((50, 5)) @ rng.standard_normal((5, 30))
    V = extended_basis(U, [states[:20], states[20:]], 12)
    # The data has rank 5: no more modes than that are added, however many are asked for.
    assert V.shape == (30, 8)
    assert np.array_equal(V[:, :3], U)
    np.testing.assert_allclose(V.T @ V, np.eye(8), atol=1e-12)
    np.testing.assert_allclose(states @ V @ V.T, states, atol=1e-10)
    assert np.array_equal(extended_basis(U, [states], 3), U)
    assert np.array_equal(extended_basis(U, [states @ U @ U.T], 9)[:, :3], U)


def mean_cost(
    model: LocalModel, theta: np.ndarray, q: float, r: float, limit: float = np.inf
) -> float:
    path = roll(model, theta, START, limit)
    return float(q * np.sum((path.x - TARGET) ** 2) + r * np.sum(path.a**2)) / STEPS


@pytest.mark.parametrize("limit", [np.inf, 0.06])
def test_gradient_is_that_of_the_closed_loop_also_where_actions_saturate(limit: float) -> None:
    model, q, r, h = planted(), 1.5, 0.3, 1e-7
    path = roll(model, THETA, START, limit)
    # Some of the actions are at the limit, and some are not.
    assert path.free is None or 0.1 < path.free.mean() < 0.9
    settings = {"target": TARGET, "state_weight": q, "action_weight": r, "gamma": 1.0}
    expansion = expand(path, model.jacobians(path.x), model.B, **settings)
    for i in range(THETA.size):
        e = h * np.eye(THETA.size)[i].reshape(THETA.shape)
        up, down = (mean_cost(model, THETA + sign * e, q, r, limit) for sign in (1, -1))
        assert expansion.gradient[i] == pytest.approx((up - down) / (2 * h), rel=1e-5, abs=1e-8)
    assert np.linalg.eigvalsh(expansion.curvature).min() > -1e-12


@pytest.mark.parametrize("limit", [np.inf, 0.06])
def test_differences_are_predicted_to_first_order_also_where_actions_saturate(limit) -> None:
    model = planted()
    first = roll(model, THETA, START, limit)
    rng = np.random.default_rng(3)
    change, shift = rng.standard_normal(THETA.shape), rng.standard_normal(R)
    errors = []
    for h in (1e-5, 1e-6):
        second = roll(model, THETA + h * change, START + h * shift, limit)
        predicted = predict_difference(
            model.jacobians(first.x)[None],
            model.B,
            THETA[:, :N_S],
            initial=h * shift[None],
            forcing=(second.features @ (h * change).T)[None],
            gammas=np.ones(1),
            free=None if first.free is None else first.free[None],
        )
        errors.append(np.abs(predicted[0, 0] - (second.x - first.x)).max())
    assert errors[1] < 0.02 * errors[0]  # of second order


def test_curvature_is_exact_where_the_trajectory_is_linear_in_theta() -> None:
    # Without feedback of the state into the actions, only b moves, and x is affine in b.
    model = planted(bend=0.0)
    theta = np.zeros_like(THETA)
    path = roll(model, theta, START)
    expansion = expand(
        path,
        model.jacobians(path.x),
        model.B,
        target=TARGET,
        state_weight=1.0,
        action_weight=0.5,
        gamma=1.0,
    )
    step = np.zeros_like(THETA)
    step[:, N_S] = [0.7, -0.4]
    d = step.ravel()
    predicted = expansion.gradient @ d + 0.5 * d @ expansion.curvature @ d
    actual = mean_cost(model, theta + step, 1.0, 0.5) - mean_cost(model, theta, 1.0, 0.5)
    assert predicted == pytest.approx(actual, rel=1e-10)


def test_forgetting_shortens_the_memory_of_the_sensitivities() -> None:
    model = planted()
    path = roll(model, THETA, START)
    settings = {"target": TARGET, "state_weight": 1.0, "action_weight": 0.1}
    arguments = (path, model.jacobians(path.x), model.B)
    none = expand(*arguments, **settings, gamma=1e-12)
    # With no memory only the direct effect on the actions is left.
    direct = 2 * 0.1 / STEPS * (path.a.T @ path.features).ravel()
    np.testing.assert_allclose(none.gradient, direct, atol=1e-9)


def test_the_true_model_has_the_smallest_mismatch() -> None:
    true, wrong = planted(), planted(7)
    change = 1e-5 * np.ones_like(THETA)
    pair = Comparison(roll(true, THETA, START), roll(true, THETA + change, START), change)
    errors = mismatches([wrong, true], [pair], STEPS)
    assert errors.shape == (2, len(KAPPAS))
    assert errors[1, 0] < 1e-4 < errors[0, 0]
    assert errors.max() <= 2.0
    assert not mismatches([wrong, true], [], STEPS).any()


def test_an_exploding_model_is_the_worst_not_an_error() -> None:
    true = planted()
    exploding = replace(true, linear=1e200 * np.eye(R))
    change = 1e-3 * np.ones_like(THETA)
    pair = Comparison(roll(true, THETA, START), roll(true, THETA + change, START), change)
    assert mismatches([exploding], [pair], STEPS)[0, 0] == 2.0
    step, fall = damped_step(
        [exploding],
        [pair.first],
        target=TARGET,
        state_weight=1.0,
        action_weight=1.0,
        gamma=1.0,
        damping=1.0,
    )
    assert np.isnan(step).all()
    assert np.isnan(fall)


def test_choices_prefer_little_forgetting_after_a_success_only() -> None:
    errors = np.full((3, len(KAPPAS)), 0.5)
    errors[1, 0], errors[0, 0], errors[1, 1] = 0.12, 0.2, 0.1
    kappa, models = choices(errors, True)[0]
    assert kappa == 0.0
    assert models == [0, 1]
    assert choices(errors, False)[0] == (KAPPAS[1], [1])
    assert sorted(k for k, _ in choices(errors, True)) == sorted(KAPPAS)


def test_the_step_shrinks_with_the_damping_and_predicts_its_fall() -> None:
    model = planted()
    path = roll(model, THETA, START)
    sizes, falls = [], []
    for damping in (0.1, 100.0, 1e6):
        step, fall = damped_step(
            [model],
            [path],
            target=TARGET,
            state_weight=1.0,
            action_weight=0.1,
            gamma=1.0,
            damping=damping,
        )
        sizes.append(float(np.linalg.norm(step)))
        falls.append(fall)
    assert sizes[0] > sizes[1] > sizes[2] > 0
    assert falls[0] > falls[1] > falls[2] > 0
    actual = mean_cost(model, THETA, 1.0, 0.1) - mean_cost(model, THETA + step, 1.0, 0.1)
    assert actual == pytest.approx(falls[2], rel=0.05)
