# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An affine law and a network with one hidden layer of the reduced state."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter
from typing import ClassVar, NamedTuple

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.laws.affine import Affine
from pdeloop.method.laws.base import Law, Parts
from pdeloop.method.settings import Settings, setting

MOST_NEURONS = 512
"""Neurons of the hidden layer, at most."""


@dataclass(frozen=True, kw_only=True)
class NeuralSettings(Settings):
    """Constants of the law `neural`."""

    neurons: int = setting(64, "neurons of the hidden layer", 1, MOST_NEURONS)
    iterations: int = setting(1500, "steps of the descent on the model", 0, 100_000)


class Layers(NamedTuple):
    """The network D tanh(W s + w) + d: (h, n_s), (h,), (n_a, h) and (n_a,) arrays."""

    W: Array
    w: Array
    D: Array
    d: Array


class Neural(Law):
    """An affine law and a network of the reduced state:

        a_k = K_a s_k + K_b s_r + D tanh(W s_k + w) + d,        s = U^T z.

    It begins as the affine law, without a network. An optimiser that has a model of the plant trains
    one and writes it into theta: `model_based` does. theta is then longer than `size` by h, the number
    of neurons, and W, w, D and d, row after row; zeros at its end mean nothing.

    Source: Goodfellow, Bengio, Courville, *Deep Learning*, 2016, chapter 6.
    """

    name = "neural"
    extends = True
    needs_model = True
    Settings = NeuralSettings
    settings: ClassVar[NeuralSettings] = NeuralSettings()

    def start(self) -> Parts:
        """K_a and K_b, (n_a, n_s) each, and no network."""
        return {"K_a": self.model.K_a, "K_b": self.model.K_b, "network": np.zeros(0)}

    def parts(self, theta: Array) -> Parts:
        """Those of the affine law are its beginning; the rest is `network`."""
        affine = Affine(self.model, self.horizon)
        return {**affine.parts(theta[: self.size]), "network": theta[self.size :]}

    def vector(self, parts: Parts) -> Array:
        gains = np.hstack([parts["K_a"], parts["K_b"]]).ravel()
        return np.concatenate([gains, parts["network"]])

    def theta_of(self, gains: Array, layers: Layers) -> Array:
        """Theta of [K_a K_b] and a network."""
        numbers = [np.array([len(layers.w)], dtype=np.float64), *map(np.ravel, layers)]
        return np.concatenate([np.ravel(gains), *numbers])

    def has_network(self, theta: Array) -> bool:
        """Whether this theta has more than gains."""
        return bool(theta[self.size :].any())

    def acting(self, theta: Array) -> str:
        """The name of the law that a theta is one of."""
        return self.name if self.has_network(theta) else Affine.name

    def layers(self, network: Array) -> Layers:
        """The network of its numbers; ValueError where they are those of none."""
        n_a, n_s = self.model.K_a.shape
        count = float(network[0])
        if not (1 <= count <= MOST_NEURONS and count == int(count)):
            raise ValueError(f"its network has {count:g} neurons; expected 1 to {MOST_NEURONS}")
        h = int(count)
        ends = np.cumsum([1, h * n_s, h, n_a * h, n_a])
        if len(network) < ends[-1]:
            raise ValueError(f"its network has {len(network)} numbers; expected {ends[-1]}")
        W, w, D, d = (network[i:j] for i, j in pairwise(ends))
        return Layers(W.reshape(h, n_s), w, D.reshape(n_a, h), d)

    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        s = self.reduced(z)
        a: Array = theta["K_a"] @ s + theta["K_b"] @ self.model.s_r
        if not theta["network"].any():
            return a
        W, w, D, d = self.layers(theta["network"])
        return a + (D @ np.tanh(W @ s + w) + d)

    def pull_back(
        self, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array]:
        s, by_network = self.reduced(z), np.zeros(len(theta["network"]))
        by_s = theta["K_a"].T @ y
        if theta["network"].any():
            W, w, D, _ = self.layers(theta["network"])
            hidden = np.tanh(W @ s + w)
            g = (1.0 - hidden**2) * (D.T @ y)
            by_s += W.T @ g
            own = np.concatenate([np.outer(g, s).ravel(), g, np.outer(y, hidden).ravel(), y])
            by_network[1 : 1 + len(own)] = own
        by_theta = {
            "K_a": np.outer(y, s),
            "K_b": np.outer(y, self.model.s_r),
            "network": by_network,
        }
        return by_theta, self.model.U @ by_s, memory

    def matrices(self, theta: Array) -> dict[str, Array]:
        """K, c, W, w and D of a = K s + c + D tanh(W s + w)."""
        parts = self.parts(theta)
        W, w, D, d = self.layers(parts["network"])
        c = parts["K_b"] @ self.model.s_r + d
        return {"K": parts["K_a"], "c": c, "W": W, "w": w, "D": D}

    def step_times(self, theta: Array, z: Array, steps: int = 12) -> tuple[float, float]:
        """Seconds of the first step from a state (n_z,), and of one of the next, in the median."""
        parts, took = self.parts(theta), list[float]()
        for k in range(steps):
            began = perf_counter()
            self.action(parts, z, np.zeros(0), k)
            took.append(perf_counter() - began)
        return took[0], float(np.median(took[1:]))

    def has_gains(self, theta: Array) -> bool:
        """Without a network it is the affine law, to the bit."""
        return not self.has_network(theta)

    def gains(self, theta: Array) -> Array:
        return theta[: self.size].reshape(self.n_a, -1)
