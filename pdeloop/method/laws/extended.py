# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws that begin as another one, and act by what an optimiser adds to its theta."""

from __future__ import annotations

from functools import cached_property
from time import perf_counter
from typing import ClassVar

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.laws.base import Law, Parts
from pdeloop.method.laws.linear import Affine, FeedForward

TIMED = 12
"""Steps that are timed."""


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

    def step_times(self, theta: Array, z: Array, steps: int = TIMED) -> tuple[float, float]:
        """Seconds of the first step from a state (n_z,), and of one of the next, in the median.

        The state stays, unless the law knows what follows it.
        """
        own = type(self)(self.model, self.horizon)
        own.cost = self.cost
        parts, memory, took = own.parts(theta), own.memory_start(), list[float]()
        for k in range(max(min(steps, self.horizon), 2)):
            began = perf_counter()
            a = own.action(parts, z, memory, k)
            if own.memory_size:
                memory = own.memory_update(parts, z, memory, a, k)
            took.append(perf_counter() - began)
            z = own.followed(parts, z, memory, a)
        return took[0], float(np.median(took[1:]))

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
