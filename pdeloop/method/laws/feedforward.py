# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Feedback with a different feed-forward at each step, a_k = K U^T z_k + b_k."""

from __future__ import annotations

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.design.finite_horizon import track_horizon
from pdeloop.method.laws.base import Law, Parts, at_step


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


class FeedForward(Law):
    """a_k = K s_k + b_k, s = U^T z, for k = 0 .. T - 1; at T and beyond b_{T-1} again.

    It starts with the LQ-tracking gains: K = K_a, and b_k = K_b s_r at all steps. A constant b cannot
    foresee the transient from one initial field to the target, of which the b_k may hold what is
    common to all fields. Where the cost is more than numbers and a constant target, the b_k are
    those of `tracking_offsets`.
    """

    name = "feedforward"

    def start(self) -> Parts:
        """K (n_a, n_s) and b (T, n_a)."""
        b = tracking_offsets(self.model, self.cost, self.horizon)
        return {"K": self.model.K_a, "b": b}

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        a: Array = theta["K"] @ self.reduced(z) + at_step(theta["b"], k)
        return a

    def pull_back(
        self, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array]:
        by_b = np.zeros_like(theta["b"])
        at_step(by_b, k)[:] = y
        by_theta = {"K": np.outer(y, self.reduced(z)), "b": by_b}
        return by_theta, self.model.U @ (theta["K"].T @ y), memory
