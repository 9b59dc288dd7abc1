# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant of `process`: rates, and profiles between insulated walls."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pde_sim_node.dynamics import Dynamics
from pdeloop.messages.arrays import Array


class Process(Dynamics):
    """dz/dt = rate(z, a), in `substeps` Runge-Kutta steps a sampling time."""

    horizon = 100
    substeps = 4
    _level: Array
    """Settled state to which an output's target belongs."""

    def rate(self, z: Array, a: Array) -> Array:
        """dz/dt."""
        raise NotImplementedError

    def step(self, z: Array, a: Array) -> Array:
        h = self.sample_time / self.substeps
        for _ in range(self.substeps):
            k1 = self.rate(z, a)
            k2 = self.rate(z + h / 2 * k1, a)
            k3 = self.rate(z + h / 2 * k2, a)
            z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + self.rate(z + h * k3, a))
        return z

    def operating_point(self) -> tuple[Array, Array]:
        """State and action at which the plant is linearised: the targets, unless an output has one."""
        state = self._level if self.output is not None else self.target
        z, a = (np.asarray(each, dtype=np.float64) for each in (state, self.action_target))
        return np.broadcast_to(z, self.n_z).copy(), np.broadcast_to(a, self.n_a).copy()

    def settled(self, z: Array, a: Array, steps: int = 500) -> Array:
        """The state after many steps of one action."""
        for _ in range(steps):
            z = self.step(z, a)
        return z


def cells(n: int) -> Array:
    """Centres of n cells of [0, 1]."""
    return (np.arange(n) + 0.5) / n


def joined(*parts: ArrayLike) -> Array:
    """Numbers and arrays, one after the other."""
    return np.concatenate([np.atleast_1d(np.asarray(part, dtype=np.float64)) for part in parts])


def humps(n: int, centres: list[float], width: float) -> Array:
    """Gaussian supports of actuators, (n, n_a)."""
    found: Array = np.exp(-0.5 * ((cells(n)[:, None] - np.array(centres)) / width) ** 2)
    return found


def cosines(rng: np.random.Generator, n: int, rms: float, count: int = 3) -> Array:
    """A random profile between insulated walls."""
    waves = np.cos(np.pi * np.outer(np.arange(count), cells(n)))
    drawn: Array = rms * np.sqrt(1.0 / count) * rng.standard_normal(count) @ waves
    return drawn


def second(u: Array) -> Array:
    """The second difference between insulated walls."""
    return np.diff(np.concatenate([[0.0], np.diff(u), [0.0]]))
