# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law and a network with one hidden layer of the reduced state beside it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, NamedTuple

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.laws.base import Parts
from pdeloop.method.laws.linear import Extended, at_step
from pdeloop.method.settings import Settings, setting

MOST_NEURONS = 512
"""Neurons of the hidden layer, at most."""


@dataclass(frozen=True, kw_only=True)
class NeuralSettings(Settings):
    """Constants of the law `neural`."""

    neurons: int = setting(64, "neurons of the hidden layer", 1, MOST_NEURONS)
    iterations: int = setting(1500, "steps of the descent on the model", 0, 100_000)


class Layers(NamedTuple):
    """The network D tanh(W x + w) + d: (h, n_x), (h,), (n_a, h) and (n_a,) arrays."""

    W: Array
    w: Array
    D: Array
    d: Array


class Neural(Extended):
    """A law and a network of the reduced state beside it:

        a_k = K s_k + b_k + D tanh(W x_k + w) + d,        s = U^T z,    x_k = s_k or [s_k; b_k],

    the latter where b_k is one of each step, which tells what targets to come ask for. It begins
    without a network; one that `model_based` trains makes theta longer by h, the number of neurons, and
    W, w, D and d, row after row.

    Source: Goodfellow, Bengio, Courville, *Deep Learning*, 2016, chapter 6.
    """

    name = "neural"
    added = "network"
    Settings = NeuralSettings
    settings: ClassVar[NeuralSettings] = NeuralSettings()

    def theta_of(self, without: Array, K: Array, layers: Layers) -> Array:
        """Theta of a network beside the law of another one with these gains K (n_a, n_s)."""
        parts = dict(self.without.parts(np.ravel(without)))
        parts["K" if "K" in parts else "K_a"] = K
        numbers = [np.array([len(layers.w)], dtype=np.float64), *map(np.ravel, layers)]
        return np.concatenate([self.without.vector(parts), *numbers])

    def layers(self, network: Array) -> Layers:
        """The network of its numbers; ValueError where they are those of none."""
        n_a, n_x = self.n_a, self._inputs
        count = float(network[0])
        if not (1 <= count <= MOST_NEURONS and count == int(count)):
            raise ValueError(f"its network has {count:g} neurons; expected 1 to {MOST_NEURONS}")
        h = int(count)
        ends = np.cumsum([1, h * n_x, h, n_a * h, n_a])
        if len(network) < ends[-1]:
            raise ValueError(f"its network has {len(network)} numbers; expected {ends[-1]}")
        W, w, D, d = (network[i:j] for i, j in pairwise(ends))
        return Layers(W.reshape(h, n_x), w, D.reshape(n_a, h), d)

    @property
    def _inputs(self) -> int:
        """n_x."""
        return len(self.model.s_r) + self.n_a * self.depends_on_step

    def _input(self, theta: Parts, z: Array, k: int) -> Array:
        """x_k."""
        s, (_, b) = self.reduced(z), self.feedback(theta)
        return s if b.ndim == 1 else np.concatenate([s, at_step(b, k)])

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        a = self.without.action(theta, z, memory, k)
        if not theta["network"].any():
            return a
        W, w, D, d = self.layers(theta["network"])
        return a + (D @ np.tanh(W @ self._input(theta, z, k) + w) + d)

    def pull_back(
        self, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array]:
        by_theta, by_z, memory = self.without.pull_back(theta, z, memory, k, y)
        by_network, n_s = np.zeros(len(theta["network"])), len(self.model.s_r)
        if theta["network"].any():
            W, w, D, _ = self.layers(theta["network"])
            x = self._input(theta, z, k)
            hidden = np.tanh(W @ x + w)
            g = (1.0 - hidden**2) * (D.T @ y)
            by_x = W.T @ g
            by_z = by_z + self.model.U @ by_x[:n_s]
            if len(by_x) > n_s:
                at_step(by_theta["b"], k)[:] += by_x[n_s:]
            own = np.concatenate([np.outer(g, x).ravel(), g, np.outer(y, hidden).ravel(), y])
            by_network[1 : 1 + len(own)] = own
        return {**by_theta, "network": by_network}, by_z, memory

    def matrices(self, theta: Array) -> dict[str, Array]:
        """K, c, W, w and D of a_k = K s_k + c_k + D tanh(W s_k + w_k).

        c and w have one row for each step where b_k has.
        """
        parts, n_s = self.parts(theta), len(self.model.s_r)
        W, w, D, d = self.layers(parts["network"])
        K, b = self.feedback(parts)
        if W.shape[1] > n_s:
            w = w + b @ W[:, n_s:].T
        return {"K": K, "c": b + d, "W": W[:, :n_s], "w": w, "D": D}
