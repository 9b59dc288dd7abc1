# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer: feedback of an estimate of the reduced state instead of the measurement."""

from __future__ import annotations

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.laws.base import Law, Parts


class Observer(Law):
    """a_k = K x_k + b with the filtered estimate x_k = p_k + L (U^T z_k - p_k) of the reduced state.

    Its memory is the prediction p_{k+1} = A x_k + B a_k; the first measurement is believed as it is.
    It starts with L = I, the filter for exact measurements, and the LQ-tracking gains, and is then the
    affine law. A smaller L averages noise over steps, as the Kalman filter does.

    Source: Anderson, Moore, *Optimal Control: Linear Quadratic Methods*, 1990, chapter 8.
    """

    name = "observer"

    @property
    def memory_size(self) -> int:  # type: ignore[override]
        return len(self.model.A)

    def start(self) -> Parts:
        """K (n_a, n_s), b (n_a,) and L (n_s, n_s)."""
        return {
            "K": self.model.K_a,
            "b": self.model.K_b @ self.model.s_r,
            "L": np.eye(len(self.model.A)),
        }

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        a: Array = theta["K"] @ self._estimate(theta, z, memory, k) + theta["b"]
        return a

    def memory_update(self, theta: Parts, z: Array, memory: Array, action: Array, k: int) -> Array:
        x = self._estimate(theta, z, memory, k)
        predicted: Array = self.model.A @ x + self.model.B @ action
        return predicted

    def pull_back(
        self, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array]:
        x = self._estimate(theta, z, memory, k)
        by_L, by_z, by_memory = self._pull_back_estimate(theta, z, memory, k, theta["K"].T @ y)
        return {"K": np.outer(y, x), "b": y, "L": by_L}, by_z, by_memory

    def pull_back_memory(
        self, theta: Parts, z: Array, memory: Array, action: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array, Array]:
        by_L, by_z, by_memory = self._pull_back_estimate(theta, z, memory, k, self.model.A.T @ y)
        none = {"K": np.zeros_like(theta["K"]), "b": np.zeros_like(theta["b"])}
        return {**none, "L": by_L}, by_z, by_memory, self.model.B.T @ y

    def _estimate(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        s = self.reduced(z)
        x: Array = memory + theta["L"] @ (s - memory) if k else s
        return x

    def _pull_back_estimate(
        self, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Array, Array, Array]:
        """The derivatives of `_estimate` by L, z and m."""
        if not k:
            return np.zeros_like(theta["L"]), self.model.U @ y, np.zeros_like(memory)
        by_s = theta["L"].T @ y
        return np.outer(y, self.reduced(z) - memory), self.model.U @ by_s, y - by_s
