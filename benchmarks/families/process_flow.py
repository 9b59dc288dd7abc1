# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants of `process` in which something flows or swings."""

from __future__ import annotations

import numpy as np

from benchmarks.families.process_base import Process, cells, cosines, humps, joined
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Axis, Grid


class Canal(Process):
    """Depths in 32 reaches and flows over the 31 edges between; four gates let water in or out."""

    n_z, n_a, sample_time, substeps = 63, 4, 0.5, 6
    action_low, action_high = -0.2, 0.2
    state_weight = joined(np.ones(32), np.full(31, 0.1))
    target = joined(np.ones(32), np.zeros(31))

    def __init__(self) -> None:
        self._B = np.zeros((32, 4))
        self._B[[2, 11, 20, 29], range(4)] = 1.0

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(1.0 + cosines(rng, 32, 0.15, 4), 0.05 * rng.standard_normal() * np.ones(31))

    def rate(self, z: Array, a: Array) -> Array:
        h, q = np.maximum(z[:32], 0.1), z[32:]
        edge = 0.5 * (h[1:] + h[:-1])
        depth = -np.diff(np.concatenate([[0.0], q, [0.0]])) + self._B @ a
        return joined(depth, -edge * np.diff(h) - 0.4 * q * np.abs(q) / edge**2 - 0.02 * q)


class Beam(Process):
    """A clamped beam of 20 points, deflection and velocity, that hardens; three piezo patches."""

    n_z, n_a, sample_time, substeps = 40, 3, 0.2, 20
    grid = Grid((Axis("x", 1.0, 20, periodic=False),), ("w", "v"))
    state_weight, action_weight = joined(np.full(20, 5.0), np.ones(20)), 0.2
    action_low, action_high = -1.0, 1.0

    def __init__(self) -> None:
        self._B = np.diff(np.diff(humps(22, [0.2, 0.5, 0.8], 0.1), axis=0), axis=0) * 5.0
        x = cells(20)
        self._mode = [
            np.sin(np.pi * j * x) ** 2 * np.sign(np.sin(np.pi * j * x)) for j in (1, 2, 3)
        ]

    def initial_state(self, rng: np.random.Generator) -> Array:
        w = sum(rng.standard_normal() * 0.3 / j * own for j, own in enumerate(self._mode, 1))
        return joined(w, np.zeros(20))

    def rate(self, z: Array, a: Array) -> Array:
        w, v = z[:20], z[20:]
        walled = np.concatenate([[0.0, 0.0], w, [0.0, 0.0]])
        bent = np.diff(walled, 4)
        return joined(v, -4.0 * bent - 0.05 * v - 0.5 * w**3 + self._B @ a)


class CoolingTower(Process):
    """Water down and air up through 15 cells; the fan and the pump carry what they move."""

    n_z, n_a, sample_time = 30, 2, 0.3
    action_low, action_high, action_weight = -0.8, 0.8, np.array([0.3, 0.2])
    output = np.eye(30)[[14, 7]]

    def __init__(self) -> None:
        level = self.settled(
            joined(np.linspace(1, 0.5, 15), np.linspace(0.6, 0.1, 15)), np.zeros(2)
        )
        self.target = level[[14, 7]] + np.array([-0.05, 0.0])
        self.state_weight, self._level = np.array([[30.0, 5.0], [5.0, 10.0]]), level

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(self._level + joined(cosines(rng, 15, 0.2), cosines(rng, 15, 0.2)))

    def rate(self, z: Array, a: Array) -> Array:
        w, g = z[:15], z[15:]
        exchanged = 2.0 * (np.exp(0.7 * w) - np.exp(0.7 * g)) * (1.0 + 0.4 * a[0])
        water = -4.0 * (1.0 + a[1]) * np.diff(w, prepend=1.0) - exchanged
        return joined(water, 4.0 * (1.0 + a[0]) * np.diff(g, append=0.1) + exchanged)


class Tanks(Process):
    """Six tanks that run into each other; two pumps of one direction, and levels never below zero."""

    n_z, n_a, sample_time = 6, 2, 0.5
    action_low, action_high, action_target, action_weight = 0.0, 2.0, 0.8, 0.1
    output = np.eye(6)[:2]
    state_weight = 5.0

    def __init__(self) -> None:
        self._level = self.settled(np.ones(6), np.full(2, 0.8))
        self.target = self._level[:2] * 1.1

    def initial_state(self, rng: np.random.Generator) -> Array:
        return np.maximum(self._level * rng.uniform(0.3, 1.7, 6), 0.0)

    def rate(self, z: Array, a: Array) -> Array:
        out = 0.5 * np.sqrt(np.maximum(z, 0.0))
        into = joined(out[2:4], out[4:6], 0.7 * a[0] + 0.3 * a[1], 0.3 * a[0] + 0.7 * a[1])
        return into - out


class HeatExchanger(Process):
    """Two counter-current streams of 20 and 16 cells; both flows are actuators."""

    n_z, n_a, sample_time, substeps = 36, 2, 0.2, 6
    action_low, action_high, action_weight = -0.5, 0.5, np.array([[0.2, 0.05], [0.05, 0.2]])

    def __init__(self) -> None:
        self._to_cold = np.array([np.maximum(0, 1 - np.abs(cells(16) - x) * 16) for x in cells(20)])
        self._to_cold /= self._to_cold.sum(axis=1, keepdims=True)
        begin = joined(np.linspace(1, 0.5, 20), np.linspace(0.5, 0, 16))
        self.target = self.settled(begin, np.array([0.1, -0.1]), 300)
        self.state_weight = joined(np.full(19, 0.2), 10.0, 10.0, np.full(15, 0.2))

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(self.target + joined(cosines(rng, 20, 0.2), cosines(rng, 16, 0.2)))

    def rate(self, z: Array, a: Array) -> Array:
        h, c = z[:20], z[20:]
        passed = 1.5 * (h - self._to_cold @ c)
        hot = -10.0 * (1.0 + a[0]) * np.diff(h, prepend=1.0) - passed
        taken = self._to_cold.T @ passed * 0.8
        return joined(hot, 8.0 * (1.0 + a[1]) * np.diff(c, append=0.0) + taken)


class GasPipeline(Process):
    """Pressures in 16 pipes and flows over 15 edges with friction q|q|/p; three compressors."""

    n_z, n_a, sample_time, substeps = 31, 3, 0.5, 8
    action_low, action_high, action_weight = 0.0, 0.6, 0.5
    action_target = 0.2

    def __init__(self) -> None:
        self._B = np.zeros((15, 3))
        self._B[[3, 7, 11], range(3)] = 1.0
        self.target = self.settled(joined(np.ones(16), np.full(15, 0.3)), np.full(3, 0.2))
        self.state_weight = joined(np.full(16, 4.0), np.ones(15))

    def initial_state(self, rng: np.random.Generator) -> Array:
        flow = 0.1 * rng.standard_normal() * np.ones(15)
        return joined(self.target + joined(cosines(rng, 16, 0.15), flow))

    def rate(self, z: Array, a: Array) -> Array:
        p, q = np.maximum(z[:16], 0.2), z[16:]
        pressure = -np.diff(np.concatenate([[0.5 * (1.2 - p[0])], q, [0.35 * p[15]]]))
        middle = 0.5 * (p[1:] + p[:-1])
        return joined(pressure, -np.diff(p) - 1.5 * q * np.abs(q) / middle + self._B @ a)


class Crane(Process):
    """A chain of 10 masses with hardening springs and dry friction, pulled at both ends."""

    n_z, n_a, sample_time, substeps = 20, 2, 0.2, 10
    grid = Grid((Axis("x", 1.0, 10, periodic=False),), ("position", "speed"))
    action_low, action_high, action_weight = -1.0, 1.0, 0.5
    state_weight = joined(np.ones(10), np.full(10, 0.3))

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(0.8 * rng.standard_normal() + cosines(rng, 10, 0.3), np.zeros(10))

    def rate(self, z: Array, a: Array) -> Array:
        x, v = z[:10], z[10:]
        stretch = np.diff(x)
        force = np.concatenate([[0.0], 4.0 * stretch + 2.0 * stretch**3, [0.0]])
        driven = np.diff(force) - 0.03 * np.tanh(v / 0.02) - 0.05 * v
        driven[0] += a[0]
        driven[-1] += a[1]
        return joined(v, driven)


class PowerGrid(Process):
    """Ten generators on a ring with two chords, angles and speeds; four batteries."""

    n_z, n_a, sample_time, substeps = 20, 4, 0.2, 8
    action_low, action_high, action_weight = -0.5, 0.5, 1.0
    state_weight = np.diag(joined(np.full(10, 0.5), np.full(10, 2.0)))

    def __init__(self) -> None:
        links = [(i, (i + 1) % 10) for i in range(10)] + [(0, 5), (2, 8)]
        self._D = np.zeros((len(links), 10))
        for row, (i, j) in enumerate(links):
            self._D[row, i], self._D[row, j] = 1.0, -1.0
        self._inertia = 1.0 + 0.5 * np.cos(np.arange(10))
        self._B = np.eye(10)[:, [0, 3, 5, 8]]

    def initial_state(self, rng: np.random.Generator) -> Array:
        return 0.4 * rng.standard_normal(20)

    def rate(self, z: Array, a: Array) -> Array:
        flows = self._D.T @ np.sin(self._D @ z[:10])
        return joined(
            z[10:], (-2.0 * flows - 0.1 * z[10:] - 0.1 * z[:10] + self._B @ a) / self._inertia
        )


class RampMeters(Process):
    """A motorway of 24 cells with a capacity; four ramps let cars in, and never take them out."""

    n_z, n_a, sample_time = 24, 4, 0.5
    action_low, action_high, action_target, action_weight = 0.0, 0.3, 0.1, 1.0
    target = 0.45

    def __init__(self) -> None:
        self._B = np.zeros((24, 4))
        self._B[[3, 9, 15, 21], range(4)] = 1.0

    def initial_state(self, rng: np.random.Generator) -> Array:
        return np.clip(0.5 + cosines(rng, 24, 0.25, 4), 0.05, 0.95)

    def rate(self, z: Array, a: Array) -> Array:
        sent, taken = np.minimum(z, 0.5) * 1.2, np.minimum(1.0 - z, 0.5) * 1.2
        flow = np.concatenate([[0.3], np.minimum(sent[:-1], taken[1:]), [0.8 * sent[-1]]])
        return -np.diff(flow) - 0.05 * z + self._B @ a
