# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Least squares in reduced coordinates: recovers systems, needs no unit, and its error is known."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pdeloop.method.reduce import regression
from pdeloop.method.reduce.regression import exact_regression
from tests.support.linear_system import assert_recovered, lift, linear_system, trajectory

N_S, N_A, STEPS = 4, 2, 60


@pytest.mark.parametrize("n_z", [N_S, 30])
def test_recovers_a_linear_system_from_pooled_trajectories(n_z: int) -> None:
    A, B = linear_system(N_S)
    # None of them alone has enough steps for n_s + n_a unknowns.
    parts = [trajectory(A, B, seed, steps=N_S + N_A - 1) for seed in (1, 2, 3)]
    onto = lift(n_z, N_S)
    model = exact_regression([(z @ onto.T, a) for z, a in parts], n_s=N_S)
    assert_recovered(model, A, B, onto, atol=1e-11)


def test_is_the_projected_least_squares_solution() -> None:
    rng = np.random.default_rng(3)
    states, actions = rng.standard_normal((STEPS + 1, 12)), rng.standard_normal((STEPS, N_A))
    model = exact_regression([(states, actions)], n_s=N_S)
    s = states @ model.U
    residual = s[1:] - s[:-1] @ model.A.T - actions @ model.B.T
    # The residual of least squares is orthogonal to all regressors.
    np.testing.assert_allclose(residual.T @ np.hstack([s[:-1], actions]), 0.0, atol=1e-11)
    left = np.linalg.svd(states[1:].T)[0][:, :N_S]
    np.testing.assert_allclose(model.U @ model.U.T, left @ left.T, atol=1e-12)


@pytest.mark.parametrize("units", [1e-9, 3.0, 1e9, [1.0, 1e-9], [1.0, 1e9]])
def test_does_not_depend_on_the_units_of_inputs(units: float | list[float]) -> None:
    rng, scale = np.random.default_rng(4), np.array(units)
    states, actions = rng.standard_normal((STEPS + 1, 20)), rng.standard_normal((STEPS, N_A))
    model, other = (exact_regression([(states, c * actions)], n_s=6) for c in (1.0, scale))
    np.testing.assert_allclose(other.A, model.A, atol=1e-12)
    np.testing.assert_allclose(scale * other.B, model.B, atol=1e-12)


def test_truncated_dmdc_is_the_same_at_full_rank() -> None:
    rng = np.random.default_rng(5)
    states, actions = rng.standard_normal((STEPS + 1, 8)), rng.standard_normal((STEPS, N_A))
    model = exact_regression([(states, actions)], n_s=8)
    truncated = regression.truncated_dmdc([(states, actions)], p=8 + N_A, n_s=8)
    for name in ("A", "B", "U"):
        np.testing.assert_allclose(getattr(truncated, name), getattr(model, name), atol=1e-12)
    # With fewer directions than n_s + n_a it loses the inputs first when they are small.
    with pytest.raises(ValueError, match=r"p = 8 keeps 0\.\d+ %, 0\.\d+ % of a move of a1 and a2"):
        regression.truncated_dmdc([(states, 1e-3 * actions)], p=8, n_s=8)
    cut = regression.truncated_dmdc([(states, 0.05 * actions)], p=8, n_s=8)
    assert np.linalg.norm(0.05 * cut.B) < 0.05 * np.linalg.norm(model.B)
    (remark,) = regression.truncation_remarks([(states, 0.05 * actions)], 8)
    assert "of a move of a1 and a2" in remark


def test_same_bits_whatever_the_threads() -> None:
    rng = np.random.default_rng(6)
    states, actions = rng.standard_normal((301, 256)), rng.standard_normal((300, 12))
    with threadpool_limits(limits=1):
        one = exact_regression([(states, actions)], n_s=24)
    with threadpool_limits(limits=4):
        four = exact_regression([(states, actions)], n_s=24)
    for name in ("A", "B", "U"):
        assert np.array_equal(getattr(one, name), getattr(four, name))


@pytest.mark.parametrize("offset", [0.0, 20.0, 293.15])
def test_data_about_an_operating_point_give_the_model_of_the_deviations(offset: float) -> None:
    """Degrees and kelvin, with heaters at half power: x+ = A x + B a + d with d = (I - A) c - B a_c."""
    A, B = linear_system(N_S)
    states, actions = trajectory(A, B, steps=STEPS)
    power = 0.0 if not offset else 50.0
    c = np.full(N_S, offset)
    model = exact_regression([(states + c, actions + power)], n_s=N_S)
    U = model.U
    np.testing.assert_allclose(U @ model.A @ U.T, A, atol=1e-8)
    np.testing.assert_allclose(U @ model.B, B, atol=1e-8)
    d = c - A @ c - B @ np.full(B.shape[1], power)
    np.testing.assert_allclose(U @ model.d, d, atol=1e-6)
    assert bool(model.d.any()) is bool(offset)


def test_a_mode_of_an_offset_alone_has_no_dynamics_but_rounding() -> None:
    """Ten sensors of three states, each with its own zero: four modes, of which one never moves."""
    rng = np.random.default_rng(0)
    A, B, C = np.diag([0.97, 0.9, 0.7]), rng.normal(size=(3, 2)), rng.normal(size=(10, 3))
    x, a = np.zeros((201, 3)), rng.normal(size=(200, 2))
    for k in range(200):
        x[k + 1] = A @ x[k] + B @ a[k] + 0.01 * rng.normal(size=3)
    z = np.round(np.linspace(20.0, 40.0, 10) + x @ C.T, 8)
    model = exact_regression([(z, a)], n_s=4, constant=True)
    assert np.abs(model.A).max() < 1.0
    expected = np.linspace(20.0, 40.0, 10) + C @ A @ [1.0, 2.0, 3.0]
    s = model.U.T @ (np.linspace(20.0, 40.0, 10) + C @ [1.0, 2.0, 3.0])
    np.testing.assert_allclose(model.U @ (model.A @ s + model.d), expected, atol=0.02)


def test_white_noise_needs_no_constant_term() -> None:
    states, actions = trajectory(*linear_system(N_S), steps=STEPS)
    noisy = states + 0.05 * np.random.default_rng(2).standard_normal(states.shape)
    found = [exact_regression([(noisy, actions)], n_s=N_S, constant=c) for c in (None, False)]
    assert np.array_equal(found[0].A, found[1].A) and not found[0].d.any()


def test_refuses_what_it_cannot_identify() -> None:
    states, actions = trajectory(*linear_system(N_S), steps=STEPS)
    with pytest.raises(ValueError, match="needs at least 6 steps, but there are 5"):
        exact_regression([(states[:6], actions[:5])], n_s=N_S)
    with pytest.raises(ValueError, match="numerical rank of the states, 4, but n_s is 5"):
        exact_regression([(states @ lift(20, N_S).T, actions)], n_s=5)
    with pytest.raises(ValueError, match="at least 1"):
        exact_regression([(states, actions)], n_s=0)
    with pytest.raises(ValueError, match="40 actions belong to 41 states"):
        exact_regression([(states, actions), (states[:40], actions[:40])], n_s=N_S)
