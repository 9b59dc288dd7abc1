# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear-quadratic tracking over a finite horizon: any quadratic cost, a target for each step.

    s_{k+1} = A s_k + B a_k + d
    J = sum_{k < T} |E s_k - w_k|^2 + (a_k - a_r)' R (a_k - a_r)  +  |E_T s_T - w_T|^2

The optimal law is a_k = K_k s_k + b_k. With the cost to go s'P s - 2 p's + const,

    S_k = R + B'P B,    K_k = -S_k^{-1} B'P A,    b_k = a_r + S_k^{-1} B'(p - P (d + B a_r)),
    P  <- E'E + A'P (A + B K_k),
    p  <- E'w_k + (A + B K_k)'(p - P (d + B a_r)),

backwards from P = E_T'E_T and p = E_T'w_T. b_k looks ahead: it knows the targets that are still to
come.

References
----------
Anderson, Moore, "Optimal Control: Linear Quadratic Methods", chapter 4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost


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
