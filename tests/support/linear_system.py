# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear systems s_{k+1} = A s_k + B a_k, and what is measured of them."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def linear_system(n_s: int, n_a: int = 2) -> tuple[Array, Array]:
    """A of spectral radius 0.95, and B."""
    rng = np.random.default_rng(0)
    A = rng.standard_normal((n_s, n_s))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    return A, rng.standard_normal((n_s, n_a))


def trajectory(A: Array, B: Array, seed: int = 1, *, steps: int) -> tuple[Array, Array]:
    """States s_0 .. s_N and white actions."""
    rng = np.random.default_rng(seed)
    actions = rng.standard_normal((steps, B.shape[1]))
    states = [rng.standard_normal(len(A))]
    for a in actions:
        states.append(A @ states[-1] + B @ a)
    return np.array(states), actions


def lift(n_z: int, n_s: int) -> Array:
    """Orthonormal columns (n_z, n_s): z = lift s."""
    return np.linalg.qr(np.random.default_rng(2).standard_normal((n_z, n_s)))[0]


def assert_recovered(model, A: Array, B: Array, onto: Array, atol: float) -> None:
    """A model of lifted trajectories is that of the system, in another basis of the lift's columns."""
    T = model.U.T @ onto
    np.testing.assert_allclose(T @ T.T, np.eye(len(A)), atol=1e-13)
    np.testing.assert_allclose(T.T @ model.A @ T, A, atol=atol)
    np.testing.assert_allclose(T.T @ model.B, B, atol=atol)
