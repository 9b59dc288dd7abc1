# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws that are linear in what is measured and remembered: `affine`, `feedforward` and `observer`.

Action and memory are sums of products of a part of theta and an input,

    a_k = sum_j Theta_j x_j,        p_{k+1} = sum_j Theta'_j x_j + B a_k,        p_0 = s_0,

with the inputs s_k = U^T z_k, p_k, s_r and 1; so are the transposed derivatives, Theta_j^T y by x_j and
y x_j^T by Theta_j. A law says which part goes with which input.

A law that is `Extended` begins as one of these, and acts by what an optimiser adds to its theta.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, reduce
from typing import ClassVar

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.design.lqt import tracking_offsets
from pdeloop.method.laws.base import Law, Parts

Terms = Mapping[str, str]
"""The input of each part: s, p, s_r or 1; one of 1 is a vector, or has a row for each step."""


class Linear(Law):
    """The base of these laws."""

    acts: ClassVar[Terms]
    remembers: ClassVar[Terms] = {}

    @property
    def outputs(self) -> tuple[Terms, ...]:
        """Of the action, and of the memory where there is one."""
        return (self.acts, self.remembers) if self.remembers else (self.acts,)

    @property
    def memory_size(self) -> int:  # type: ignore[override]
        return len(self.model.A) if self.remembers else 0

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        return self._sum(self.acts, theta, z, memory, k)

    def memory_update(self, theta: Parts, z: Array, memory: Array, action: Array, k: int) -> Array:
        return self._sum(self.remembers, theta, z, memory, k) + self.model.B @ action

    def pull_back(
        self, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array]:
        return self._pulled(self.acts, theta, z, memory, k, y)

    def pull_back_memory(
        self, theta: Parts, z: Array, memory: Array, action: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array, Array]:
        found = self._pulled(self.remembers, theta, z, memory, k, y)
        return *found, self.model.B.T @ y

    def _inputs(self, z: Array, memory: Array, k: int) -> dict[str, Array]:
        s = self.reduced(z)  # nothing is known before the first measurement
        return {"s": s, "p": memory if k else s, "s_r": self.model.s_r}

    def _sum(self, terms: Terms, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        x = self._inputs(z, memory, k)
        found: Array = reduce(
            np.add,
            [
                at_step(theta[name], k) if own == "1" else theta[name] @ x[own]
                for name, own in terms.items()
            ],
        )
        return found

    def _pulled(
        self, terms: Terms, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array]:
        """y times the derivatives of `_sum` by theta, z and memory."""
        x = self._inputs(z, memory, k)
        by_theta = {name: np.zeros_like(part) for name, part in theta.items()}
        by = {name: np.zeros_like(own) for name, own in x.items()}
        for name, own in terms.items():
            if own == "1":
                at_step(by_theta[name], k)[:] = y
            else:
                by_theta[name][:] = np.outer(y, x[own])
                by[own] += theta[name].T @ y
        by_s = by["s"] if k else by["s"] + by["p"]
        by_memory = by["p"] if k and self.remembers else np.zeros_like(memory)
        return by_theta, self.model.U @ by_s, by_memory


class Affine(Linear):
    """The paper's law, a_k = K_a s_k + K_b s_r, s = U^T z; theta is [K_a K_b], row after row.

    It starts with the LQ-tracking gains. Its compiled form is theta itself.

    Source: Zhang, Mowlavi, Benosman, Basar, arXiv:2403.01005, section III.
    """

    name = "affine"
    compiled = True
    axes = 2
    acts: ClassVar[Terms] = {"K_a": "s", "K_b": "s_r"}

    def start(self) -> Parts:
        """K_a and K_b of the model, (n_a, n_s) each."""
        return {"K_a": self.model.K_a, "K_b": self.model.K_b}

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


class FeedForward(Linear):
    """a_k = K s_k + b_k, s = U^T z, for k = 0 .. T - 1; at T and beyond b_{T-1} again.

    It starts with the LQ-tracking gains: K = K_a, and b_k = K_b s_r at all steps, or where the cost is
    more than numbers and a constant target those of `tracking_offsets`. The b_k may hold what is common
    to the transients from all fields.
    """

    name = "feedforward"
    acts: ClassVar[Terms] = {"K": "s", "b": "1"}

    def start(self) -> Parts:
        """K (n_a, n_s) and b (T, n_a)."""
        b = tracking_offsets(self.model, self.cost, self.horizon)
        return {"K": self.model.K_a, "b": b}


class Observer(Linear):
    """A linear compensator of full order, with the newest measurement s_k = U^T z_k as it comes:

        p_{k+1} = F p_k + G s_k + B a_k + c,        a_k = K p_k + D s_k + b,        p_0 = s_0

    It starts as the LQG law of the model: with its filter gain L, x_k = p_k + L (s_k - p_k) estimates
    the reduced state, p_{k+1} = A x_k + B a_k predicts it, and the tracking gains act on x_k:

        F = A (I - L),    G = A L,    K = K_a (I - L),    D = K_a L,    b = K_b s_r,    c = d,

    with K_b s_r and what the rows of the model have besides it (`ModelRows.constant`).

    Where the target moves, b and c have a row for each step, and the b_k are those of `feedforward`.
    a_k in p_{k+1} is what the plant gets, so that a saturated action misleads no prediction. A model
    without a filter gain has L = I, the filter for exact measurements: this is then the affine law.

    Source: Anderson, Moore, *Optimal Control: Linear Quadratic Methods*, 1990, chapter 8.
    """

    name = "observer"
    filtered = True
    from_readings = "subspace"
    acts: ClassVar[Terms] = {"D": "s", "K": "p", "b": "1"}
    remembers: ClassVar[Terms] = {"G": "s", "F": "p", "c": "1"}

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


def at_step(part: Array, k: int) -> Array:
    """The row of step k of a part with one for each step, the last one beyond it; else the part."""
    return part if part.ndim < 2 else part[min(k, len(part) - 1)]


class Extended(Law):
    """A law whose theta is that of `without`, and after it numbers that it acts by in its place.

    It begins without them. Zeros at the end of theta mean nothing.
    """

    extends = True
    needs_model = True
    added: ClassVar[str] = ""
    """The part of theta that is added."""

    @cached_property
    def without(self) -> Law:
        """The law that it begins as, and stays where nothing better is found.

        `feedforward` where the target moves, or is 0 and takes actions other than 0; else `affine`.
        """
        cost = self.cost
        offsets = cost is not None and (
            cost.target.ndim > 1 or (cost.action_target.any() and not cost.target.any())
        )
        law = (FeedForward if offsets else Affine)(self.model, self.horizon)
        law.cost = cost
        return law

    @property
    def depends_on_step(self) -> bool:
        """Whether b_k is one of each step."""
        return isinstance(self.without, FeedForward)

    def start(self) -> Parts:
        """The parts of `without`, and nothing added."""
        return {**self.without.start(), self.added: np.zeros(0)}

    def parts(self, theta: Array) -> Parts:
        """Those of `without` are its beginning; the rest is what is added."""
        size = self.without.size
        return {**self.without.parts(theta[:size]), self.added: theta[size:]}

    def vector(self, parts: Parts) -> Array:
        return np.concatenate([self.without.vector(parts), parts[self.added]])

    def is_extended(self, theta: Array) -> bool:
        """Whether anything is added in this theta."""
        return bool(theta[self.without.size :].any())

    def acting(self, theta: Array) -> str:
        """The name of the law that a theta is one of."""
        return self.that_acts(theta)[0].name

    def followed(self, theta: Parts, z: Array, memory: Array, a: Array) -> Array:
        """What is measured after z and a, as far as theta tells; memory: after that step."""
        return z

    def has_gains(self, theta: Array) -> bool:
        """With nothing added it is `without`, to the bit."""
        own = theta[: self.without.size]
        return not self.is_extended(theta) and self.without.has_gains(own)

    def gains(self, theta: Array) -> Array:
        return self.without.gains(theta[: self.without.size])

    def that_acts(self, theta: Array) -> tuple[Law, Array]:
        """The law that a theta is one of, and its theta."""
        if self.is_extended(theta):
            return self, theta
        return self.without, theta[: self.without.size]

    def feedback(self, theta: Parts) -> tuple[Array, Array]:
        """K (n_a, n_s) and b of `without`, a_k = K s_k + b_k: (n_a,), or a row for each step."""
        if self.depends_on_step:
            return theta["K"], theta["b"]
        return theta["K_a"], theta["K_b"] @ self.model.s_r
