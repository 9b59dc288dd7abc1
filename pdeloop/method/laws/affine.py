# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The paper's law, a = K_a U^T z + K_b U^T z_r, with theta = [K_a K_b].

Source: Zhang, Mowlavi, Benosman, Basar, arXiv:2403.01005, section III.
"""

from __future__ import annotations

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.laws.base import Law, Parts


class Affine(Law):
    """a_k = K_a s_k + K_b s_r, s = U^T z; theta is the matrix [K_a K_b], row after row.

    It starts with the LQ-tracking gains. Its compiled form is theta itself.
    """

    name = "affine"
    compiled = True
    axes = 2

    def start(self) -> Parts:
        """K_a and K_b of the model, (n_a, n_s) each."""
        return {"K_a": self.model.K_a, "K_b": self.model.K_b}

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        a: Array = theta["K_a"] @ self.reduced(z) + theta["K_b"] @ self.model.s_r
        return a

    def pull_back(
        self, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array]:
        by_theta = {"K_a": np.outer(y, self.reduced(z)), "K_b": np.outer(y, self.model.s_r)}
        return by_theta, self.model.U @ (theta["K_a"].T @ y), memory

    def gains(self, theta: Array) -> Array:
        return theta.reshape(self.shape)

    def parts(self, theta: Array) -> Parts:
        """K_a and K_b stand side by side in the rows of theta."""
        K_a, K_b = np.hsplit(theta.reshape(self.shape), 2)
        return {"K_a": K_a, "K_b": K_b}

    def vector(self, parts: Parts) -> Array:
        return np.hstack([parts["K_a"], parts["K_b"]]).ravel()

    @property
    def shape(self) -> tuple[int, ...]:
        """(n_a, 2 n_s)."""
        n_a, n_s = self.model.K_a.shape
        return n_a, 2 * n_s
