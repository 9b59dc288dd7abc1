# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The law of a plant whose inputs act late: the last inputs belong to its state.

With delays n_j of the inputs, s_{k+1} = A s_k + sum_j B_j a_{j,k-n_j} + d is, with all inputs that have
not acted yet,

    x_k = [s_k; a_{j,k-1} .. a_{j,k-n_j} of every j],        x_{k+1} = A_x x_k + B_x a_k + d_x,

a model without delays, whose LQ-tracking gains are optimal for the plant with its dead times. Of x the
measurement determines s alone; the law `observer` remembers the rest, as it is what it answered.

References
----------
Åström, Wittenmark, "Computer-Controlled Systems", 3rd ed., section 2.3 (sampling systems with delays).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.design.lqt import DesignError, track_outputs
from pdeloop.method.reduce.input_delay import Delays
from pdeloop.process.one_thread import one_thread

__all__ = ["with_dead_time"]


def with_dead_time(
    rows: ModelRows,
    delays: Delays,
    target: Array,
    *,
    state_weight: float,
    action_weight: float,
    cost: Cost | None = None,
    or_no_control: bool = False,
) -> ModelRows:
    """A model with the last inputs in its state, its law, and the filter that it had, or L = I.

    Parameters
    ----------
    rows : ModelRows
        The model without delays, z_{k+1} by a_{k-n}.
    delays : tuple of int
        n of each input; those below 0 count as 0.
    target : (n_z,) array
        z_r.
    state_weight, action_weight : float
        q and r.
    cost : Cost, optional
        In place of them.
    or_no_control : bool
        Gains of 0 where there are no stabilising ones.

    Raises
    ------
    DesignError
        There are no stabilising gains.
    """
    late = [max(n, 0) for n in delays]
    n_s, n_a, memory = len(rows.A), len(late), sum(late)
    newest = n_s + np.cumsum([0, *late[:-1]])
    A, B = np.zeros((n_s + memory, n_s + memory)), np.zeros((n_s + memory, n_a))
    A[:n_s, :n_s] = rows.A
    for j, n in enumerate(late):
        if not n:
            B[:n_s, j] = rows.B[:, j]
            continue
        first = newest[j]
        B[first, j] = 1.0
        A[first + 1 : first + n, first : first + n - 1] = np.eye(n - 1)
        A[:n_s, first + n - 1] = rows.B[:, j]
    none = np.zeros(memory)
    d = None if rows.d is None else np.concatenate([rows.d, none])
    seen = np.hstack([rows.measurement, np.zeros((len(rows.U), memory))])
    if cost is None or cost.plain:
        cost = Cost(
            len(rows.U),
            n_a,
            1,
            state_weight=state_weight,
            action_weight=action_weight,
            target=target,
        )
    try:
        gains = track_outputs(A, B, seen, cost, 0.0 if d is None else d)
        K_a, b = gains.K_a, gains.b + gains.K_b @ (seen.T @ cost.field_target)
    except DesignError:
        if not or_no_control:
            raise
        K_a, b = np.zeros_like(B.T), np.zeros(n_a)
    s_r = np.concatenate([rows.s_r, none])
    size = float(s_r @ s_r)
    with one_thread():
        K_b = np.outer(b, s_r) / size if size > 0.0 else np.zeros_like(K_a)
        L = linalg.block_diag(np.eye(n_s) if rows.L is None else rows.L, np.zeros((memory, memory)))
    U = np.hstack([rows.U, np.zeros((len(rows.U), memory))])
    return replace(rows, A=A, B=B, U=U, K_a=K_a, K_b=K_b, s_r=s_r, L=L, d=d)
