# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""DMDc recovers linear systems, is unique, and refuses what it cannot identify."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.reduce.reduced_model import ReducedModel
from pdeloop.method.reduce.regression import truncated_dmdc
from tests.support.linear_system import lift, linear_system, trajectory

N_S, N_A, STEPS = 3, 2, 40


def test_is_the_formula_of_the_paper() -> None:
    rng = np.random.default_rng(3)
    states, actions = rng.standard_normal((STEPS + 1, 12)), rng.standard_normal((STEPS, N_A))
    p, n_s = 7, 4
    model = truncated_dmdc([(states, actions)], p=p, n_s=n_s)
    psi, xi, lam_t = np.linalg.svd(np.vstack([states[:-1].T, actions.T]), full_matrices=False)
    truncated = lam_t[:p].T @ np.diag(1.0 / xi[:p])
    left = model.U.T @ states[1:].T @ truncated
    np.testing.assert_allclose(model.A, left @ psi[:12, :p].T @ model.U, atol=1e-12)
    np.testing.assert_allclose(model.B, left @ psi[12:, :p].T, atol=1e-12)


def test_basis_is_unique_and_repeatable() -> None:
    states, actions = trajectory(*linear_system(N_S), steps=STEPS)
    first = truncated_dmdc([(states, actions)], p=5, n_s=N_S)
    again = truncated_dmdc([(states.copy(), actions.copy())], p=5, n_s=N_S)
    for name in ("A", "B", "U"):
        assert np.array_equal(getattr(first, name), getattr(again, name))
    # The opposite trajectory has opposite singular vectors; the sign rule gives the same basis.
    opposite = truncated_dmdc([(-states, -actions)], p=5, n_s=N_S)
    np.testing.assert_allclose(opposite.U, first.U, atol=1e-13)
    largest = np.abs(first.U).argmax(axis=0)
    assert (first.U[largest, np.arange(N_S)] > 0).all()


@pytest.mark.parametrize(
    ("p", "n_s", "message"),
    [
        (0, 1, "at least 1"),
        (3, 0, "at least 1"),
        (23, 3, r"at most min\(n_z \+ n_a, N\) = 22"),
        (6, 3, "numerical rank of the data, 5"),
        (5, 4, "numerical rank of the states, 3"),
        (3, 4, "at most p = 3"),
    ],
)
def test_refuses_more_than_the_trajectory_holds(p: int, n_s: int, message: str) -> None:
    states, actions = trajectory(*linear_system(N_S), steps=STEPS)
    with pytest.raises(ValueError, match=message):
        truncated_dmdc([(states @ lift(20, N_S).T, actions)], p=p, n_s=n_s)


def test_refuses_short_and_malformed_trajectories() -> None:
    states, actions = trajectory(*linear_system(N_S), steps=STEPS)
    lost, lost_actions = states.copy(), actions.copy()
    lost[7, 1], lost_actions[3, 0] = np.nan, np.inf
    for known, message in (
        ((states[:5], actions[:4]), "= 4, but p is 5"),
        ((states[:-1], actions), "40 actions belong to 41 states, but 40"),
        ((states[0], actions), "non-empty matrix"),
        ((states[:1], actions[:0]), "non-empty matrix"),
        ((lost, actions), "row 7"),
        ((states, lost_actions), "actions must be finite, but row 3"),
    ):
        with pytest.raises(ValueError, match=message):
            truncated_dmdc([known], p=5, n_s=3)


def test_reduced_model_checks_itself_and_is_read_only() -> None:
    A, B, U = np.eye(2), np.ones((2, 1)), np.eye(5)[:, :2]
    model = ReducedModel(A=A, B=B, U=U)
    A[0, 0] = 7.0
    assert model.A[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        model.A[0, 0] = 2.0
    with pytest.raises(ValueError, match="needs B with 3 rows"):
        ReducedModel(A=np.eye(3), B=B, U=U)
    with pytest.raises(ValueError, match="needs U with 3 columns"):
        ReducedModel(A=np.eye(3), B=np.ones((3, 1)), U=U)
    with pytest.raises(ValueError, match="needs B with 2 rows"):
        ReducedModel(A=np.eye(2), B=np.ones((3, 1)), U=U)
    with pytest.raises(ValueError, match="B of a reduced model must be finite"):
        ReducedModel(A=np.eye(2), B=B * np.nan, U=U)
    with pytest.raises(ValueError, match="U of a reduced model must be a non-empty matrix"):
        ReducedModel(A=np.eye(2), B=B, U=np.ones(5))
