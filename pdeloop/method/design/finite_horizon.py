# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear-quadratic control of a linear model over a finite horizon, for any quadratic cost.

    s_{k+1} = A s_k + B a_k + d
    J = sum_{k < T} |E s_k - w_k|^2 + (a_k - a_r)' R (a_k - a_r)  +  |E_T s_T - w_T|^2

`track_horizon`, with a target for each step: a_k = K_k s_k + b_k. With the cost to go s'P s - 2 p's +
const,

    S_k = R + B'P B,    K_k = -S_k^{-1} B'P A,    b_k = a_r + S_k^{-1} B'(p - P (d + B a_r)),
    P  <- E'E + A'P (A + B K_k),
    p  <- E'w_k + (A + B K_k)'(p - P (d + B a_r)),

backwards from P = E_T'E_T and p = E_T'w_T. b_k looks ahead: it knows the targets that are still to
come.

`finite_horizon`, about a point that need not be an equilibrium, and with one target: the first step's
law a = K e + b of the deviation e. The Riccati recursion of [e; 1] is doubled until it covers the
horizon, which is rounded up to a power of two. Unlike the algebraic equation it needs no stabilisable
model.

References
----------
Anderson, Moore, "Optimal Control: Linear Quadratic Methods", chapter 4; "Optimal Filtering", section
6.7 (doubling).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows


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
    whole, inputs, P = _regulated(A, B, drift, state_weight, action_weight, horizon)
    return _first_step(whole, inputs, P, action_weight * np.eye(B.shape[1]))


def finite_horizon_of(
    A: Array, B: Array, drift: Array, cost: Cost, point: Array
) -> tuple[Array, Array]:
    """The same law for any quadratic cost, of the deviation e = z - point; point is (n,).

    A target over time counts with its mean, and the terminal weight does not count.
    """
    whole, inputs = _extended(A, B, drift + B @ cost.action_target)
    P = cost_to_go(A, B, drift, cost, point)
    K, b = _first_step(whole, inputs, P, cost.action_matrix)
    return K, b + cost.action_target


def cost_to_go(A: Array, B: Array, drift: Array, cost: Cost, point: Array) -> Array:
    """P (n + 1, n + 1) of the least cost [e; 1]^T P [e; 1] of the horizon, for `finite_horizon_of`."""
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
    _, inputs, P = _regulated(A, B, np.zeros(len(A)), state_weight, action_weight, horizon)
    curvature: Array = action_weight * np.eye(B.shape[1]) + inputs.T @ P @ inputs
    return curvature


def _extended(A: Array, B: Array, drift: Array) -> tuple[Array, Array]:
    """The system of [e; 1]."""
    n, n_a = B.shape
    whole = np.block([[A, drift[:, None]], [np.zeros((1, n)), np.ones((1, 1))]])
    return whole, np.vstack([B, np.zeros((1, n_a))])


def _regulated(
    A: Array, B: Array, drift: Array, state_weight: float, action_weight: float, horizon: int
) -> tuple[Array, Array, Array]:
    """The system of [e; 1], and P of the least cost sum_k q |e_k|^2 + r |a_k|^2."""
    whole, inputs = _extended(A, B, drift)
    P = np.diag(np.append(np.full(len(A), state_weight), 0.0))
    return whole, inputs, _doubled(whole, inputs @ inputs.T / action_weight, P, horizon)


def _first_step(whole: Array, inputs: Array, P: Array, R: Array) -> tuple[Array, Array]:
    """K and b of the first step of the horizon whose cost to go is P."""
    gains = -linalg.solve(R + inputs.T @ P @ inputs, inputs.T @ P @ whole, assume_a="pos")
    return gains[:, :-1], gains[:, -1]


def _doubled(whole: Array, G: Array, P: Array, horizon: int) -> Array:
    """P after the horizon, from that of one step."""
    n, power, eye = len(whole) - 1, whole, np.eye(len(whole))
    for _ in range(int(np.ceil(np.log2(max(horizon, 1))))):
        solved = linalg.solve(eye + G @ P, np.hstack([power, G]))
        own, reach = solved[:, : n + 1], solved[:, n + 1 :]
        G, P = G + power @ reach @ power.T, P + power.T @ P @ own
        power = power @ own
    return P


class TimeVaryingGains(NamedTuple):
    """The law a_k = K_k s_k + b_k.

    Attributes
    ----------
    K : (T, n_a, n_s) array
        Feedback of each step.
    b : (T, n_a) array
        Feedforward of each step.
    """

    K: Array
    b: Array


def track_horizon(
    A: ArrayLike, B: ArrayLike, cost: Cost, basis: ArrayLike, drift: ArrayLike = 0.0
) -> TimeVaryingGains:
    """The optimal law of a linear model over the cost's horizon.

    Parameters
    ----------
    A, B : (n_s, n_s) and (n_s, n_a)
        The model.
    cost : Cost
        Cost of the states z = basis s.
    basis : (n_z, n_s)
        U of a reduced model; the identity for a model of the whole state.
    drift : (n_s,)
        d.

    Returns
    -------
    TimeVaryingGains
        K (T, n_a, n_s) and b (T, n_a).

    Examples
    --------
    With T = 2 the last action affects no state in the cost, and the first one anticipates the next
    target:

    >>> cost = Cost(1, 1, 2, action_weight=1.0, target=[[0.0], [3.0]])
    >>> K, b = track_horizon([[1.0]], [[1.0]], cost, [[1.0]])
    >>> K.ravel() + 0.0, b.ravel()
    (array([-0.5,  0. ]), array([1.5, 0. ]))
    """
    A, B = np.asarray(A, dtype=np.float64), np.asarray(B, dtype=np.float64)
    basis = np.asarray(basis, dtype=np.float64)
    E, w, R = cost.residual(basis), cost.residual_target(), cost.action_matrix
    last = cost.residual(basis, terminal=True)
    P, p = last.T @ last, last.T @ cost.residual_target(terminal=True)
    pushed = np.broadcast_to(drift, len(A)) + B @ cost.action_target
    K = np.empty((cost.horizon, cost.n_a, len(A)))
    b = np.empty((cost.horizon, cost.n_a))
    for k in reversed(range(cost.horizon)):
        solve = linalg.cho_factor(R + B.T @ P @ B)
        ahead = p - P @ pushed
        K[k] = -linalg.cho_solve(solve, B.T @ P @ A)
        b[k] = cost.action_target + linalg.cho_solve(solve, B.T @ ahead)
        closed = A + B @ K[k]
        P = E.T @ E + A.T @ P @ closed
        P, p = 0.5 * (P + P.T), E.T @ w[k] + closed.T @ ahead
    return TimeVaryingGains(K, b)


def tracking_offsets(model: ModelRows, cost: Cost | None, horizon: int) -> Array:
    """b_k (T, n_a) of a_k = K_a s_k + b_k, by LQ tracking over the horizon on the model.

    It looks ahead to the targets to come: a_k on its way from s_0 = 0, less what the first of its laws
    does for the mean target, on its own way. K_b s_r is of that target, and knows of a constant term
    d that A and B do not tell:

        b_k = K_b s_r + (a_k - K_a s_k) - (a'_k - K_a s'_k).

    Without a cost of this horizon all b_k are K_b s_r.
    """
    b = np.tile(model.constant, (horizon, 1))
    if cost is not None and cost.horizon == horizon:
        z_of, d = model.measurement, 0.0 if model.d is None else model.d
        K, ahead = track_horizon(model.A, model.B, cost, z_of, d)
        steady = track_horizon(model.A, model.B, cost.steady(), z_of, d).b[0]
        s = rest = np.zeros(len(model.A))
        for k in range(horizon):
            a, held = K[k] @ s + ahead[k], K[0] @ rest + steady
            b[k] += a - held - model.K_a @ (s - rest)
            s, rest = model.A @ s + model.B @ a + d, model.A @ rest + model.B @ held + d
    return b
