# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer: feedback of an estimate of the reduced state instead of the measurement."""

from __future__ import annotations

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.design.lqt import tracking_offsets
from pdeloop.method.laws.base import Law, Parts, at_step


class Observer(Law):
    """A linear compensator of full order, with the newest measurement s_k = U^T z_k as it comes:

        p_{k+1} = F p_k + G s_k + B a_k + c,        a_k = K p_k + D s_k + b,        p_0 = s_0

    It starts as the LQG law of the model: with its filter gain L, x_k = p_k + L (s_k - p_k) estimates
    the reduced state, p_{k+1} = A x_k + B a_k predicts it, and the tracking gains act on x_k:

        F = A (I - L),    G = A L,    K = K_a (I - L),    D = K_a L,    b = K_b s_r,    c = d,

    with K_b s_r and what the rows of the model have besides it (`ModelRows.constant`).

    Where the target moves, b and c have a row for each step, b_k and c_k, and the b_k are those of
    `feedforward`: an estimate takes the place of the state (separation), and the target is known ahead.

    Its memory is p_k. B is the model's, and a_k is what the plant gets, so that a saturated action
    misleads no prediction. A model without a filter gain has L = I, the filter for exact measurements:
    this is then the affine law.

    Source: Anderson, Moore, *Optimal Control: Linear Quadratic Methods*, 1990, chapter 8.
    """

    name = "observer"
    filtered = True
    from_readings = "subspace"

    @property
    def memory_size(self) -> int:  # type: ignore[override]
        return len(self.model.A)

    def start(self) -> Parts:
        """K (n_a, n_s), D (n_a, n_s), b (n_a,), F (n_s, n_s), G (n_s, n_s) and c (n_s,).

        For a moving target b (T, n_a) and c (T, n_s).
        """
        model, eye = self.model, np.eye(len(self.model.A))
        L = eye if model.L is None else model.L
        b, c = model.constant, np.zeros(len(eye)) if model.d is None else model.d
        if self.cost is not None and self.cost.target.ndim > 1:
            b = tracking_offsets(model, self.cost, self.horizon)
            c = np.tile(c, (self.horizon, 1))
        return {
            "K": model.K_a @ (eye - L),
            "D": model.K_a @ L,
            "b": b,
            "F": model.A @ (eye - L),
            "G": model.A @ L,
            "c": c,
        }

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        s = self.reduced(z)
        a: Array = theta["K"] @ self._prediction(s, memory, k) + theta["D"] @ s
        return a + at_step(theta["b"], k)

    def memory_update(self, theta: Parts, z: Array, memory: Array, action: Array, k: int) -> Array:
        s = self.reduced(z)
        p = theta["F"] @ self._prediction(s, memory, k) + theta["G"] @ s
        after: Array = p + at_step(theta["c"], k) + self.model.B @ action
        return after

    def pull_back(
        self, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array]:
        s = self.reduced(z)
        own = {"K": np.outer(y, self._prediction(s, memory, k)), "D": np.outer(y, s)}
        none = {name: np.zeros_like(theta[name]) for name in ("b", "F", "G", "c")}
        at_step(none["b"], k)[:] = y
        by_z, by_memory = self._by_inputs(theta["K"].T @ y, theta["D"].T @ y, k)
        return {**own, **none}, by_z, by_memory

    def pull_back_memory(
        self, theta: Parts, z: Array, memory: Array, action: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array, Array]:
        s = self.reduced(z)
        none = {name: np.zeros_like(theta[name]) for name in ("K", "D", "b", "c")}
        at_step(none["c"], k)[:] = y
        own = {"F": np.outer(y, self._prediction(s, memory, k)), "G": np.outer(y, s)}
        by_z, by_memory = self._by_inputs(theta["F"].T @ y, theta["G"].T @ y, k)
        return {**none, **own}, by_z, by_memory, self.model.B.T @ y

    @staticmethod
    def _prediction(s: Array, memory: Array, k: int) -> Array:
        """p_k: nothing is known before the first measurement."""
        return memory if k else s

    def _by_inputs(self, by_p: Array, by_s: Array, k: int) -> tuple[Array, Array]:
        """The derivatives by z and m, of those by p and s."""
        if not k:
            return self.model.U @ (by_p + by_s), np.zeros_like(by_p)
        return self.model.U @ by_s, by_p
