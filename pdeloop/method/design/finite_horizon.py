# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear-quadratic control over a finite horizon, about a point that need not be an equilibrium.

    e_{k+1} = A e_k + B a_k + d,        J = sum_k q |e_k|^2 + r |a_k|^2

The Riccati recursion of [e; 1] is doubled until it covers the horizon, which is rounded up to a power
of two. Unlike the algebraic equation it needs no stabilisable model.

References
----------
Anderson, Moore, "Optimal Filtering", section 6.7 (doubling).
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost


def finite_horizon(
    A: Array, B: Array, drift: Array, state_weight: float, action_weight: float, horizon: int
) -> tuple[Array, Array]:
    """The law a = K e + b that is optimal over a horizon, in its first step.

    drift (n,) is d.

    Returns
    -------
    K (n_a, n), b (n_a,)

    Examples
    --------
    >>> K, b = finite_horizon(np.eye(1), np.eye(1), np.zeros(1), 1.0, 1.0, 64)
    >>> K.round(6), b
    (array([[-0.618034]]), array([-0.]))
    """
    whole, inputs = _extended(A, B, drift)
    P = _cost_to_go(whole, inputs, state_weight, action_weight, horizon)
    curvature = action_weight * np.eye(B.shape[1]) + inputs.T @ P @ inputs
    gains = -linalg.solve(curvature, inputs.T @ P @ whole, assume_a="pos")
    return gains[:, : len(A)], gains[:, len(A)]


def finite_horizon_of(
    A: Array, B: Array, drift: Array, cost: Cost, point: Array
) -> tuple[Array, Array]:
    """The same law for any quadratic cost, of the deviation e = z - point; point is (n,).

    A target over time counts with its mean, and the terminal weight does not count.
    """
    whole, inputs = _extended(A, B, drift + B @ cost.action_target)
    P, R = cost_to_go(A, B, drift, cost, point), cost.action_matrix
    gains = -linalg.solve(R + inputs.T @ P @ inputs, inputs.T @ P @ whole, assume_a="pos")
    return gains[:, : len(A)], gains[:, len(A)] + cost.action_target


def cost_to_go(A: Array, B: Array, drift: Array, cost: Cost, point: Array) -> Array:
    """P of the least cost [e; 1]^T P [e; 1] of the horizon, for `finite_horizon_of`.

    Returns
    -------
    (n + 1, n + 1)
    """
    whole, inputs = _extended(A, B, drift + B @ cost.action_target)
    E = cost.residual(np.eye(len(A)))
    offset = E @ point - cost.residual_target().mean(axis=0)
    rows = np.column_stack([E, offset])
    G = inputs @ linalg.solve(cost.action_matrix, inputs.T, assume_a="pos")
    return _doubled(whole, G, rows.T @ rows, cost.horizon)


def action_curvature(
    A: Array, B: Array, state_weight: float, action_weight: float, horizon: int
) -> Array:
    """R + B^T P B (n_a, n_a): the cost of a deviation from the optimal action, to second order.

    Examples
    --------
    >>> action_curvature(np.eye(1), np.eye(1), 1.0, 1.0, 64).round(6)
    array([[2.618034]])
    """
    whole, inputs = _extended(A, B, np.zeros(len(A)))
    P = _cost_to_go(whole, inputs, state_weight, action_weight, horizon)
    curvature: Array = action_weight * np.eye(B.shape[1]) + inputs.T @ P @ inputs
    return curvature


def _extended(A: Array, B: Array, drift: Array) -> tuple[Array, Array]:
    """The system of [e; 1]."""
    n, n_a = B.shape
    whole = np.block([[A, drift[:, None]], [np.zeros((1, n)), np.ones((1, 1))]])
    return whole, np.vstack([B, np.zeros((1, n_a))])


def _cost_to_go(
    whole: Array, inputs: Array, state_weight: float, action_weight: float, horizon: int
) -> Array:
    """P of [e; 1]^T P [e; 1], the least cost of the horizon."""
    n = len(whole) - 1
    P = np.diag(np.append(np.full(n, state_weight), 0.0))
    return _doubled(whole, inputs @ inputs.T / action_weight, P, horizon)


def _doubled(whole: Array, G: Array, P: Array, horizon: int) -> Array:
    """P after the horizon, from that of one step."""
    n, power, eye = len(whole) - 1, whole, np.eye(len(whole))
    for _ in range(int(np.ceil(np.log2(max(horizon, 1))))):
        solved = linalg.solve(eye + G @ P, np.hstack([power, G]))
        own, reach = solved[:, : n + 1], solved[:, n + 1 :]
        G, P = G + power @ reach @ power.T, P + power.T @ P @ own
        power = power @ own
    return P
