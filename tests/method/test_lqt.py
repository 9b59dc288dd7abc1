# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The tracking gains solve the Riccati equation, are optimal, and reach the best steady state."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg

from pdeloop.method.design.lqt import DesignError, track
from pdeloop.method.reduce.reduced_model import ReducedModel

N_Z, N_S, N_A = 10, 4, 2
Q_WEIGHT, R_WEIGHT = 1.5, 0.3


def model(radius: float = 1.05, seed: int = 0) -> ReducedModel:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((N_S, N_S))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    U = np.linalg.qr(rng.standard_normal((N_Z, N_S)))[0]
    return ReducedModel(A=A, B=rng.standard_normal((N_S, N_A)), U=U)


def diagonal_model(eigenvalues: list[float], B: list[list[float]]) -> ReducedModel:
    return ReducedModel(A=np.diag(eigenvalues), B=np.array(B), U=np.eye(N_Z)[:, : len(eigenvalues)])


@pytest.mark.parametrize("radius", [0.8, 1.0, 1.3])
def test_gains_satisfy_the_riccati_equation(radius: float) -> None:
    m = model(radius)
    gains = track(m, state_weight=Q_WEIGHT, action_weight=R_WEIGHT)
    Q, R = Q_WEIGHT * m.U.T @ m.U, R_WEIGHT * np.eye(N_A)
    closed = m.A + m.B @ gains.K_a
    assert np.abs(linalg.eigvals(closed)).max() < 1.0
    # P from the Lyapunov equation of the closed loop, which does not involve the Riccati solver.
    P = linalg.solve_discrete_lyapunov(closed.T, Q + gains.K_a.T @ R @ gains.K_a)
    S = R + m.B.T @ P @ m.B
    residual = Q + m.A.T @ P @ m.A - P - m.A.T @ P @ m.B @ linalg.solve(S, m.B.T @ P @ m.A)
    assert linalg.norm(residual) < 1e-10 * linalg.norm(P)
    np.testing.assert_allclose(S @ gains.K_a, -m.B.T @ P @ m.A, atol=1e-9)
    expected = m.B.T @ linalg.inv(np.eye(N_S) - closed.T) @ Q
    np.testing.assert_allclose(S @ gains.K_b, expected, atol=1e-9)
    assert np.array_equal(gains.policy, np.hstack([gains.K_a, gains.K_b]))


PAIR = np.array([[0.66, -0.88, 0.0], [0.88, 0.66, 0.0], [0.0, 0.0, 0.3]])
"""With eigenvalues of magnitude 1.1."""


@pytest.mark.parametrize(
    ("A", "b", "words"),
    [
        (np.diag([0.5, 1.0]), [1.0, 0.0], "eigenvalue magnitude 1"),
        (np.diag([0.5, -1.0]), [1.0, 0.0], "eigenvalue magnitude 1"),
        (np.diag([0.5, 1.25]), [1.0, 0.0], "eigenvalue magnitude 1.25"),
        (PAIR, [0.0, 0.0, 1.0], r"eigenvalue magnitude 1\.1 "),
        (np.diag([0.5, 1.3]), [1.0, 1e-11], "."),  # barely reached
    ],
)
def test_refuses_a_mode_that_no_actuator_reaches(A: np.ndarray, b: list[float], words: str) -> None:
    with pytest.raises(DesignError, match=words):
        track(ReducedModel(A, np.array(b)[:, None]), state_weight=1.0, action_weight=1.0)


def test_accepts_a_stable_mode_that_no_actuator_reaches() -> None:
    gains = track(diagonal_model([0.99, 1.2], [[0.0], [1.0]]), state_weight=1.0, action_weight=1.0)
    assert gains.K_a[0, 0] == pytest.approx(0.0, abs=1e-12)
    assert abs(1.2 + gains.K_a[0, 1]) < 1.0


@pytest.mark.parametrize("weight", [0.0, -1.0, np.nan, np.inf])
def test_refuses_weights_that_are_not_positive(weight: float) -> None:
    with pytest.raises(ValueError, match="state_weight must be positive"):
        track(model(), state_weight=weight, action_weight=1.0)
    with pytest.raises(ValueError, match="action_weight must be positive"):
        track(model(), state_weight=1.0, action_weight=weight)


@pytest.mark.parametrize("unit", [1e-13, 1e-6, 1e6, 1e13])
def test_the_units_of_state_and_inputs_change_no_law(unit: float) -> None:
    """Inputs or states in another unit, with the weight that makes them as dear as before."""
    m = model(1.3)
    same = track(m, state_weight=Q_WEIGHT, action_weight=R_WEIGHT)
    other = track(
        ReducedModel(A=m.A, B=m.B * unit, U=m.U),
        state_weight=Q_WEIGHT,
        action_weight=R_WEIGHT * unit**2,
    )
    state = track(
        ReducedModel(A=m.A, B=m.B * unit, U=m.U),
        state_weight=Q_WEIGHT / unit**2,
        action_weight=R_WEIGHT,
    )
    for name in ("K_a", "K_b"):
        expected = getattr(same, name)
        np.testing.assert_allclose(getattr(other, name) * unit, expected, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(getattr(state, name) * unit, expected, rtol=1e-6, atol=1e-9)
