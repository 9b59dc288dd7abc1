# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Feedback with a different feed-forward at each step, a_k = K U^T z_k + b_k."""

from __future__ import annotations

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.design.tracking import track_horizon
from pdeloop.method.laws.base import Law, Parts


class FeedForward(Law):
    """a_k = K s_k + b_k, s = U^T z, for k = 0 .. T - 1; at T and beyond b_{T-1} again.

    It starts with the LQ-tracking gains: K = K_a, and b_k = K_b s_r at all steps. A constant b cannot
    foresee the transient from one initial field to the target, of which the b_k may hold what is
    common to all fields.

    Where the cost is more than numbers and a constant target, K and b_k are those of LQ tracking over
    the horizon, which looks ahead to the targets to come: K is its first one, and b_k makes up for the
    difference to the later ones on the way that the model takes from s = 0.
    """

    name = "feedforward"

    def start(self) -> Parts:
        """K (n_a, n_s) and b (T, n_a)."""
        model, cost = self.model, self.cost
        if cost is not None and cost.horizon == self.horizon:
            K, b = track_horizon(model.A, model.B, cost, model.U)
            s, first = np.zeros(len(model.A)), K[0]
            for k in range(self.horizon):
                a = K[k] @ s + b[k]
                b[k] = a - first @ s
                s = model.A @ s + model.B @ a
            return {"K": first, "b": b}
        return {
            "K": self.model.K_a,
            "b": np.tile(self.model.K_b @ self.model.s_r, (self.horizon, 1)),
        }

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        a: Array = theta["K"] @ self.reduced(z) + theta["b"][self._row(k)]
        return a

    def pull_back(
        self, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array]:
        by_b = np.zeros_like(theta["b"])
        by_b[self._row(k)] = y
        by_theta = {"K": np.outer(y, self.reduced(z)), "b": by_b}
        return by_theta, self.model.U @ (theta["K"].T @ y), memory

    def _row(self, k: int) -> int:
        return min(k, self.horizon - 1)
