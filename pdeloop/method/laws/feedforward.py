# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Feedback with a different feed-forward at each step, a_k = K U^T z_k + b_k."""

from __future__ import annotations

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.design.lqt import tracking_offsets
from pdeloop.method.laws.base import Law, Parts, at_step


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
