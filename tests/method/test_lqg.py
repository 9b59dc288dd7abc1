# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""LQG: the steady-state filter, the noise that data show, and the law that begins with both."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg

from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.design.lqg import kalman_filter, noise_of, require_detectable, with_filter
from pdeloop.method.design.lqt import DesignError, track
from pdeloop.method.laws import Observer
from pdeloop.method.reduce.reduced_model import ReducedModel

N, N_A, N_Y = 4, 2, 3
RNG = np.random.default_rng(8)
A = RNG.standard_normal((N, N))
A *= 1.05 / np.abs(linalg.eigvals(A)).max()  # unstable by itself
B = RNG.standard_normal((N, N_A))
C = RNG.standard_normal((N_Y, N))
W = np.diag([0.3, 0.1, 0.2, 0.4])
V = np.diag([0.5, 0.2, 0.3])
Q, R = 2.0, 0.5


def model(**others: np.ndarray) -> ModelRows:
    gains = track(ReducedModel(A, B, np.eye(N)), state_weight=Q, action_weight=R)
    return ModelRows(A, B, np.eye(N), gains.K_a, gains.K_b, np.zeros(N), **others)


def test_the_filter_is_where_the_riccati_recursion_ends() -> None:
    P = np.eye(N)
    for _ in range(500):
        M = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
        P = A @ (P - M @ C @ P) @ A.T + W
    found = kalman_filter(A, C, W, V)
    np.testing.assert_allclose(found.P, P, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(found.M, M, rtol=1e-8, atol=1e-9)
    assert np.abs(found.poles).max() < 1.0


def closed_loop(law: Observer) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of [x; p]: the matrix, what w and v move, and the rows of a; the plant is the law's model."""
    p = law.parts(law.theta_start)
    acts = np.hstack([p["D"], p["K"]])
    matrix = np.block([[A, np.zeros((N, N))], [p["G"], p["F"]]]) + np.vstack([B, B]) @ acts
    into = np.block([[np.eye(N), B @ p["D"]], [np.zeros((N, N)), p["G"] + B @ p["D"]]])
    return matrix, into, acts


def test_the_law_separates_estimation_and_control_and_costs_what_lqg_costs() -> None:
    """Poles are those of control and filter; the cost is tr P_c W + tr K' S K P_f."""
    measured = 0.3 * np.eye(N)
    found = kalman_filter(A, np.eye(N), W, measured)
    law = Observer(model(L=found.M), 10)
    matrix, into, acts = closed_loop(law)
    gains = track(ReducedModel(A, B, np.eye(N)), state_weight=Q, action_weight=R)
    poles = np.concatenate([gains.poles, found.poles])
    np.testing.assert_allclose(
        np.sort_complex(linalg.eigvals(matrix)), np.sort_complex(poles), atol=1e-8
    )
    noise = into @ linalg.block_diag(W, measured) @ into.T
    moments = linalg.solve_discrete_lyapunov(matrix, noise)
    S_a = acts @ moments @ acts.T
    p = law.parts(law.theta_start)
    S_a += p["D"] @ measured @ p["D"].T
    cost = Q * np.trace(moments[:N, :N]) + R * np.trace(S_a)
    error = (np.eye(N) - found.M) @ found.P  # covariance of the estimate after the measurement
    S = R * np.eye(N_A) + B.T @ gains.P @ B
    expected = np.trace(gains.P @ W) + np.trace(gains.K_a.T @ S @ gains.K_a @ error)
    assert cost == pytest.approx(expected, rel=1e-8)


def simulated(sigma: float, steps: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng, s = np.random.default_rng(5), np.zeros(N)
    stable = A / 1.3
    states, actions = [s], rng.standard_normal((steps, N_A))
    for a, w in zip(actions, rng.multivariate_normal(np.zeros(N), W, steps), strict=True):
        s = stable @ s + B @ a + w
        states.append(s)
    return np.array(states) + sigma * rng.standard_normal((steps + 1, N)), actions


def test_measurement_and_process_noise_are_told_apart_in_the_residuals() -> None:
    rows = ModelRows(A / 1.3, B, np.eye(N), np.zeros((N_A, N)), np.zeros((N_A, N)), np.zeros(N))
    process, measurement = noise_of(rows, [simulated(0.4)])
    np.testing.assert_allclose(measurement, 0.16 * np.eye(N), atol=0.03)
    np.testing.assert_allclose(process, W, atol=0.06)
    # Without any the measurement is believed, and a copy of a trajectory says nothing new.
    exact = with_filter(rows, [simulated(0.0), simulated(0.0)]).L
    assert exact is not None
    np.testing.assert_allclose(exact, np.eye(N), atol=1e-3)


def test_a_mode_that_no_reading_sees_is_refused_by_name() -> None:
    growing = np.diag([1.2, 0.9, 0.5, 0.1])
    require_detectable(growing, np.eye(N)[:1])
    with pytest.raises(DesignError, match=r"grows by the factor 1.2 a step .* move or add sensors"):
        kalman_filter(growing, np.eye(N)[1:], W, np.eye(N - 1))
    turning = linalg.block_diag(1.1 * np.array([[0.0, -1.0], [1.0, 0.0]]), 0.5 * np.eye(2))
    with pytest.raises(DesignError, match=r"factor 1.1 a step and turns by 1.57 rad"):
        kalman_filter(turning, np.eye(N)[2:], W, np.eye(2))
    # Two equal modes, which one reading sees only together.
    with pytest.raises(DesignError, match="do not observe"):
        require_detectable(1.1 * np.eye(2), np.array([[1.0, 1.0]]))
