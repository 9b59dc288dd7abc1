# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law from a model of the whole field is optimal on the linearised plant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller_node.identification import DesignSettings, design
from loop_interfaces.model_rows import ModelRows
from loop_method.design.field_law import field_law, reproducing
from loop_method.design.finite_horizon import finite_horizon
from loop_method.field_models.convolution import ConvolutionModel

Array = np.ndarray
N_Z, N_A, STEPS = 24, 3, 64
Q, R = 1.0, 2.0


def plant() -> ConvolutionModel:
    """Waves up to the third grow until a cubic holds them; the actuators are blocks of the domain."""
    waves = np.arange(N_Z // 2 + 1)
    linear = 1.1 * np.exp(-0.02 * waves**2)
    symbols = np.stack([linear, 0.0 * linear, -0.1 + 0.0 * linear]).astype(complex)
    B = 0.1 * np.kron(np.eye(N_A), np.ones((N_Z // N_A, 1))) * (np.arange(N_Z) % 3 > 0)[:, None]
    return ConvolutionModel(symbols[:, None, None], B, np.zeros(N_Z))


def episode(model: ConvolutionModel, noise: float = 0.0) -> tuple[Array, Array]:
    rng = np.random.default_rng(3)
    states = [0.01 * rng.standard_normal(N_Z)]
    actions = 0.1 * rng.standard_normal((STEPS, N_A))
    for a in actions:
        states.append(model.step(states[-1], a))
    return np.array(states) + noise * rng.standard_normal((STEPS + 1, N_Z)), actions


def settings(identification: str) -> DesignSettings:
    return DesignSettings(N_A, 6, Q, R, identification=identification)


def law(true: ConvolutionModel, target: Array) -> ModelRows:
    """The field law, compared with no control."""
    trajectories = [episode(true)]
    other = design(trajectories, target, settings("regression"))
    none = replace(other, K_a=0.0 * other.K_a, K_b=0.0 * other.K_b)
    rows = field_law(trajectories, target, none, state_weight=Q, action_weight=R)
    assert rows is not None
    return rows


def test_is_the_recursion_of_riccati_over_the_horizon() -> None:
    rng = np.random.default_rng(0)
    A, B, d = rng.standard_normal((5, 5)), rng.standard_normal((5, 2)), rng.standard_normal(5)
    P, p = np.zeros((5, 5)), np.zeros(5)
    for _ in range(9):  # after the steps 7 .. 0 the law of one more, the first of eight
        S = R * np.eye(2) + B.T @ P @ B
        K, b = -np.linalg.solve(S, B.T @ P @ A), -np.linalg.solve(S, B.T @ (P @ d + p))
        closed = A + B @ K
        # a^T (R a + B^T (P (A e + B a + d) + p)) vanishes at the optimum
        P, p = Q * np.eye(5) + A.T @ P @ closed, closed.T @ (P @ d + p)
    own = finite_horizon(A, B, d, Q, R, 8)
    np.testing.assert_allclose(own[0], K, rtol=1e-8)
    np.testing.assert_allclose(own[1], b, rtol=1e-8)


@pytest.mark.parametrize("size", [0.0, 0.3])
def test_is_the_law_of_the_true_plant_linearised_at_the_target(size: float) -> None:
    true = plant()
    target = size * np.cos(2.0 * np.pi * np.arange(N_Z) / N_Z)
    A = true.jacobians(target[None], np.eye(N_Z))[0]
    drift = true.step(target, np.zeros(N_A)) - target
    K, b = finite_horizon(A, true.B, drift, Q, R, STEPS)
    rows = law(true, target)
    np.testing.assert_allclose(rows.U.T @ rows.U, np.eye(6), atol=1e-12)
    assert np.linalg.norm(rows.K_a @ rows.U.T - K) < 0.01 * np.linalg.norm(K)
    constant = (rows.K_a + rows.K_b) @ rows.s_r
    np.testing.assert_allclose(constant, b if size else 0.0 * b, atol=0.01)
    np.testing.assert_allclose(rows.A, rows.U.T @ A @ rows.U, atol=0.01)


def test_gives_way_to_a_law_that_costs_no_more() -> None:
    true, target = plant(), np.zeros(N_Z)
    best = law(true, target)
    again = field_law([episode(true)], target, best, state_weight=Q, action_weight=R)
    assert again is None


def test_takes_the_regression_where_no_model_reproduces_the_episode() -> None:
    target = np.zeros(N_Z)
    noisy = [episode(plant(), noise=1.0)]
    assert reproducing(noisy, target) is None
    rows, plain = (design(noisy, target, settings(name)) for name in ("field", "regression"))
    assert np.array_equal(rows.U, plain.U) and np.array_equal(rows.policy, plain.policy)
