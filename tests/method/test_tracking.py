# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""LQ tracking of any quadratic cost: the best actions by least squares, and the stationary law."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import linalg

from pdeloop.messages.cost import Cost
from pdeloop.method.design.lqt import regulator, track, track_horizon
from pdeloop.method.models.linear import LinearModel
from pdeloop.method.reduce.reduced_model import ReducedModel

N, N_A, T, N_Y = 4, 2, 9, 3
RNG = np.random.default_rng(3)
A = RNG.standard_normal((N, N)) / 2
B = RNG.standard_normal((N, N_A))
C = RNG.standard_normal((N_Y, N))
DRIFT = RNG.standard_normal(N)
WHOLE: dict[str, Any] = {
    "state_weight": [1.0, 3.0, 0.2],
    "action_weight": [[0.5, 0.1], [0.1, 0.4]],
    "target": RNG.standard_normal((T + 1, N_Y)),
    "output": C,
    "action_target": [0.3, -0.2],
    "terminal_weight": 5.0,
}


def best_actions(cost: Cost, s0: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """All actions of an episode at once, by least squares: no recursion and no Riccati equation."""
    size = T * N_A

    def residuals(actions: np.ndarray) -> np.ndarray:
        s, rows = s0, []
        E, w = cost.residual(np.eye(N)), cost.residual_target()
        root = linalg.cholesky(cost.action_matrix)
        for k in range(T):
            a = actions[k * N_A : (k + 1) * N_A]
            rows += [E @ s - w[k], root @ (a - cost.action_target)]
            s = A @ s + B @ a + drift
        rows.append(
            cost.residual(np.eye(N), terminal=True) @ s - cost.residual_target(terminal=True)
        )
        return np.concatenate(rows)

    zero = residuals(np.zeros(size))
    matrix = np.stack([residuals(unit) - zero for unit in np.eye(size)], axis=1)
    return np.linalg.lstsq(matrix, -zero)[0].reshape(T, N_A)


@pytest.mark.parametrize("words", [WHOLE, {"target": 1.5, "state_weight": np.diag([1, 2, 3, 4.0])}])
def test_the_law_over_a_horizon_is_the_best_sequence_of_actions(words: Any) -> None:
    cost, s = Cost(N, N_A, T, **words), RNG.standard_normal(N)
    expected = best_actions(cost, s, DRIFT)
    K, b = track_horizon(A, B, cost, np.eye(N), DRIFT)
    for k in range(T):
        a = K[k] @ s + b[k]
        np.testing.assert_allclose(a, expected[k], atol=1e-9)
        s = A @ s + B @ a + DRIFT


def test_far_from_its_end_a_long_horizon_has_the_stationary_law() -> None:
    words = WHOLE | {"target": [1.0, -0.5, 2.0], "terminal_weight": 0.0}
    cost = Cost(N, N_A, 400, **words)
    model = ReducedModel(A=A, B=B, U=np.eye(N))
    gains = track(model, state_weight=1.0, action_weight=1.0, cost=cost)
    K, b = track_horizon(A, B, cost, np.eye(N))
    np.testing.assert_allclose(gains.K_a, K[0], atol=1e-9)
    np.testing.assert_allclose(gains.K_b @ cost.field_target, b[0], atol=1e-9)
    point = RNG.standard_normal(N)
    about = regulator(LinearModel("linear", A, B, np.zeros(N)), cost, point)
    assert about is not None
    np.testing.assert_allclose(about.K, K[0], atol=1e-9)
    np.testing.assert_allclose(about.b, b[0], atol=1e-9)
