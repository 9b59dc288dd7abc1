# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants of `process` in which something reacts, separates or grows."""

from __future__ import annotations

import numpy as np

from benchmarks.families.process_base import Process, cells, cosines, joined, second
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Axis, Grid


class Column(Process):
    """A binary column of 20 trays; reflux and boil-up carry the composition, and ends count."""

    n_z, n_a, sample_time = 20, 2, 0.5
    action_low, action_high = -0.5, 0.5
    action_weight = np.array([[0.05, 0.02], [0.02, 0.05]])

    def __init__(self) -> None:
        self._level = self.settled(np.linspace(0.95, 0.05, 20), np.zeros(2))
        self.output = np.zeros((4, 20))
        self.output[0, 0] = self.output[1, 19] = 1.0
        self.output[2, 5] = self.output[3, 14] = 0.3
        self.target = self.output @ self._level
        self.state_weight = np.diag([20.0, 20.0, 5.0, 5.0]) + 2.0

    def initial_state(self, rng: np.random.Generator) -> Array:
        return np.clip(np.linspace(0.9, 0.1, 20) + cosines(rng, 20, 0.12), 0.01, 0.99)

    def rate(self, z: Array, a: Array) -> Array:
        L, V = 2.0 + a[0], 2.5 + a[1]
        vapour = 2.5 * z / (1.0 + 1.5 * z)
        above, below = np.concatenate([[vapour[0]], z[:-1]]), np.append(vapour[1:], 0.0)
        found = np.where(np.arange(20) < 10, L, L + 1.0) * (above - z) + V * (below - vapour)
        found[10] += 0.5 - z[10]
        found[19] = (L + 1.0) * z[18] - V * vapour[19] - (L + 1.0 - V) * z[19]
        found[0] = (V * (vapour[1] - z[0])) / 5.0
        return joined(found / 4.0)


class Crystallizer(Process):
    """A population of crystals in 30 sizes, the solute and the temperature; jacket and feed."""

    n_z, n_a, sample_time = 32, 2, 0.5
    action_low, action_high = np.array([-0.5, 0.0]), np.array([0.5, 0.3])
    action_target, action_weight = np.array([0.0, 0.1]), np.array([0.3, 0.6])

    def __init__(self) -> None:
        self.target = self.settled(joined(np.full(30, 0.2), 0.8, 0.0), np.array([0.0, 0.1]))
        self.state_weight = joined(np.full(30, 0.5), 4.0, 4.0)

    def initial_state(self, rng: np.random.Generator) -> Array:
        sizes = np.maximum(self.target[:30] * (1.0 + cosines(rng, 30, 0.4)), 0.0)
        return joined(sizes, self.target[30:] + 0.15 * rng.standard_normal(2))

    def rate(self, z: Array, a: Array) -> Array:
        n, c, T = z[:30], z[30], z[31]
        over = max(c - 0.5 * np.exp(T), 0.0)
        born, grown = 2.0 * over**2, 6.0 * over * n
        flux = np.concatenate([[born], grown])
        used = 0.04 * over * np.sum(n * cells(30) ** 2) * 30.0
        return joined(
            -np.diff(flux) - 0.1 * n, a[1] + 0.1 * (0.9 - c) - used, 0.4 * (a[0] - T) + 0.2 * used
        )


class FuelCell(Process):
    """A channel of 12 cells, oxygen, water and temperature; air, cooling and humidity."""

    n_z, n_a, sample_time, substeps = 36, 3, 0.2, 6
    action_low, action_high, action_weight = -0.4, 0.6, np.diag([0.2, 0.1, 0.1])
    grid = Grid((Axis("x", 1.0, 12, periodic=False),), ("oxygen", "water", "temperature"))

    def __init__(self) -> None:
        begin = joined(np.linspace(0.9, 0.5, 12), np.linspace(0.3, 0.7, 12), np.full(12, 0.3))
        self.target = self.settled(begin, np.zeros(3))
        self.state_weight = joined(np.ones(12), np.ones(12), np.full(12, 5.0))

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(self.target + np.concatenate([cosines(rng, 12, 0.15) for _ in range(3)]))

    def rate(self, z: Array, a: Array) -> Array:
        o, w, T = z.reshape(3, 12)
        u = 4.0 * (1.0 + a[0])
        load = 0.8 * np.maximum(o, 0.0) / (0.3 + np.maximum(o, 0.0)) * np.exp(0.5 * T)
        load *= np.minimum(1.0, 0.4 + w)  # a dry membrane conducts less
        do = -u * np.diff(o, prepend=1.0) - load
        dw = -u * np.diff(w, prepend=0.3 + 0.5 * a[2]) + load - 0.6 * w * np.exp(T)
        return joined(do, dw, 0.5 * second(T) * 4.0 + load - (1.2 + a[1]) * T)


class ReactorCascade(Process):
    """Four stirred tanks in a row with an exothermic reaction; each jacket only cools."""

    n_z, n_a, sample_time = 8, 4, 0.1
    action_low, action_high, action_target, action_weight = 0.0, 1.0, 0.4, 0.2

    def __init__(self) -> None:
        self.target = self.settled(joined(0.8, 0.6, 0.4, 0.3, np.full(4, 0.1)), np.full(4, 0.4))
        self.state_weight = joined(np.ones(4), np.full(4, 10.0))

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(
            self.target + joined(0.15 * rng.standard_normal(4), 0.04 * rng.standard_normal(4))
        )

    def rate(self, z: Array, a: Array) -> Array:
        C, T = z[:4], z[4:]
        k = 0.8 * np.exp(15.0 * T / (1.0 + T)) * C
        cooled = 2.0 * a * (T + 0.2)
        return joined(
            -2.0 * np.diff(C, prepend=1.0) - k,
            -2.0 * np.diff(T, prepend=0.0) + 0.4 * k - cooled,
        )


class Biofilter(Process):
    """Substrate and oxygen along 16 cells with Monod kinetics; air in four zones, never negative."""

    n_z, n_a, sample_time = 32, 4, 0.2
    action_low, action_high, action_target, action_weight = 0.0, 1.5, 0.4, 0.2
    grid = Grid((Axis("x", 1.0, 16, periodic=False),), ("substrate", "oxygen"))

    def __init__(self) -> None:
        self._B = np.kron(np.eye(4), np.ones((4, 1)))
        self.target = self.settled(np.full(32, 0.5), np.full(4, 0.4))
        self.state_weight = joined(np.full(16, 2.0), np.ones(16))

    def initial_state(self, rng: np.random.Generator) -> Array:
        drawn = self.target + joined(cosines(rng, 16, 0.25), cosines(rng, 16, 0.2))
        return joined(np.maximum(drawn, 0.0))

    def rate(self, z: Array, a: Array) -> Array:
        s, o = np.maximum(z[:16], 0.0), np.maximum(z[16:], 0.0)
        used = 2.0 * s / (0.3 + s) * o / (0.2 + o)
        air = 3.0 * (self._B @ a) * (1.0 - o)
        return joined(
            -3.0 * np.diff(s, prepend=1.0) - used, -3.0 * np.diff(o, prepend=0.3) - used + air
        )


class Fermenter(Process):
    """Biomass, substrate, product and oxygen; feed and stirrer act through products with the state."""

    n_z, n_a, sample_time = 4, 2, 0.5
    action_low, action_high, action_weight = np.array([0.0, -0.5]), np.array([0.4, 1.0]), 0.5
    action_target = np.array([0.12, 0.0])
    state_weight = np.array([2.0, 2.0, 1.0, 1.0])

    def __init__(self) -> None:
        self.target = self.settled(np.array([1.0, 0.3, 0.5, 0.6]), np.asarray(self.action_target))

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(self.target * rng.uniform(0.6, 1.4, 4))

    def rate(self, z: Array, a: Array) -> Array:
        x, s, p, o = np.maximum(z, 0.0)
        grown = 0.5 * s / (0.2 + s + s**2 / 1.5) * o / (0.2 + o) * x
        return np.array(
            [
                grown - a[0] * x,
                a[0] * (2.0 - s) - 1.6 * grown,
                0.6 * grown + 0.02 * x - a[0] * p,
                1.5 * (1.0 + a[1]) * (1.0 - o) - 2.0 * grown,
            ]
        )


class ReactingPlate(Process):
    """A plate of 8 by 8 cells with a reaction that ignites; four coolers of one direction."""

    n_z, n_a, sample_time = 64, 4, 0.2
    grid = Grid((Axis("y", 1.0, 8, periodic=False), Axis("x", 1.0, 8, periodic=False)))
    action_low, action_high, action_weight, target = -2.0, 0.0, 0.05, 0.2

    def __init__(self) -> None:
        x = cells(8)
        spot = [np.exp(-0.5 * ((x - c) / 0.15) ** 2) for c in (0.25, 0.75)]
        self._B = np.stack([np.outer(p, q).ravel() for p in spot for q in spot], axis=1)

    def initial_state(self, rng: np.random.Generator) -> Array:
        first, other = cosines(rng, 8, 0.5, 2), cosines(rng, 8, 0.5, 2)
        return (0.4 + np.outer(first, np.ones(8)) + np.outer(np.ones(8), other)).ravel()

    def rate(self, z: Array, a: Array) -> Array:
        u = z.reshape(8, 8)
        flow = np.apply_along_axis(second, 0, u) + np.apply_along_axis(second, 1, u)
        return (
            (0.6 * flow + u * (1.0 - u) * np.where(u > 0.0, 1.0, 0.0)).ravel()
            - 0.4 * z
            + self._B @ a
        )


class WebDryer(Process):
    """Moisture and temperature of a web through 20 cells; four hot-air boxes and the web's speed."""

    n_z, n_a, sample_time = 40, 5, 0.2
    action_low, action_high = joined(np.zeros(4), -0.3), joined(np.full(4, 1.5), 0.3)
    action_target, action_weight = joined(np.full(4, 0.6), 0.0), joined(np.full(4, 0.2), 1.0)

    def __init__(self) -> None:
        self._B = np.kron(np.eye(4), np.ones((5, 1)))
        self.target = self.settled(np.full(40, 0.5), np.asarray(self.action_target))
        self.state_weight = joined(np.full(15, 0.5), np.full(5, 10.0), np.full(20, 0.5))

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(self.target + joined(cosines(rng, 20, 0.2), cosines(rng, 20, 0.1)))

    def rate(self, z: Array, a: Array) -> Array:
        m, T = z[:20], z[20:]
        dried = 1.5 * np.maximum(m, 0.0) * np.exp(1.5 * (T - 0.5))
        dried = np.where(
            m < 0.3, dried * np.maximum(m, 0.0) / 0.3, dried
        )  # the last water is bound
        u, air = 5.0 * (1.0 + a[4]), self._B @ a[:4]
        return joined(
            -u * np.diff(m, prepend=1.0) - dried,
            -u * np.diff(T, prepend=0.2) + 2.0 * (air - T) - 0.3 * dried,
        )
