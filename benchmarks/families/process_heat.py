# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants of `process` that are heated, cooled or charged."""

from __future__ import annotations

import numpy as np

from benchmarks.families.process_base import Process, cells, cosines, humps, joined, second
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Axis, Grid


class Furnace(Process):
    """A muffle of 30 cells with conduction and radiation; four burners that only heat."""

    n_z, n_a, sample_time = 30, 4, 1.0
    action_low, action_high, action_weight = 0.0, 2.0, 0.05
    grid = Grid((Axis("x", 1.0, 30, periodic=False),))

    def __init__(self) -> None:
        self.target = 1.0 + 0.3 * np.sin(np.pi * cells(30))
        self._B = 0.12 * humps(30, [0.1, 0.37, 0.63, 0.9], 0.08)

    def initial_state(self, rng: np.random.Generator) -> Array:
        return 0.5 + 0.15 * rng.standard_normal() + cosines(rng, 30, 0.1)

    def rate(self, z: Array, a: Array) -> Array:
        return 0.3 * second(z) - 0.03 * (np.abs(z) ** 3 * z + 0.3 * z) + self._B @ a


class Greenhouse(Process):
    """Air, soil, humidity and CO2 under a day of sun; heater, vent and CO2 valve, each one-sided."""

    n_z, n_a, sample_time, horizon = 6, 3, 0.25, 120
    action_low, action_high, action_target = (
        0.0,
        np.array([2.0, 1.0, 1.0]),
        np.array([0.5, 0.2, 0.2]),
    )
    target, action_weight = np.array([1.0, 0.8, 0.6, 1.0, 0.0, 0.0]), 0.1
    state_weight = np.array([4.0, 0.5, 2.0, 2.0, 0.0, 0.0])

    def initial_state(self, rng: np.random.Generator) -> Array:
        air = np.array([0.6, 0.7, 0.7, 0.8]) + 0.15 * rng.standard_normal(4)
        phase = rng.uniform(0.0, 2.0 * np.pi)
        return joined(air, np.cos(phase), np.sin(phase))

    def rate(self, z: Array, a: Array) -> Array:
        T, soil, wet, co2, c, s = z
        sun, vent = max(0.0, 0.6 * c), 0.1 + a[1]
        air = (
            0.5 * (soil - T) - 0.3 * vent * (T - 0.2 - 0.2 * c) + 0.4 * a[0] + 0.5 * sun - 0.15 * T
        )
        water = 0.12 * (1.0 + sun) - vent * (wet - 0.3) * 0.5
        return np.array(
            [
                air,
                0.1 * (T - soil),
                water,
                0.8 * a[2] - vent * (co2 - 0.4) * 0.5 - 0.3 * sun * co2,
                -0.4 * s,
                0.4 * c,
            ]
        )


class BatteryPack(Process):
    """Eight cells in a row, charge and temperature; currents and a common fan that only cools."""

    n_z, n_a, sample_time = 16, 9, 1.0
    action_low = joined(np.full(8, -1.0), 0.0)
    action_high = np.ones(9)
    target, state_weight = joined(np.full(8, 0.7), np.zeros(8)), joined(np.ones(8), np.full(8, 2.0))
    action_weight = np.diag(joined(np.full(8, 0.05), 0.1)) + 0.01

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(rng.uniform(0.2, 0.6, 8), 0.2 + 0.1 * rng.standard_normal(8))

    def rate(self, z: Array, a: Array) -> Array:
        charge, T, current = z[:8], z[8:], a[:8]
        resistance = 0.15 * (1.0 + 2.0 * (charge - 0.5) ** 2) * np.exp(-0.5 * T)
        cooled = (0.05 + 0.4 * a[8]) * (T + 0.3)
        return joined(
            0.05 * current - 0.002 * charge, resistance * current**2 + 0.2 * second(T) - cooled
        )


class DeadZone(Process):
    """A rod of 24 cells whose valves move nothing within a dead zone of 0.1."""

    n_z, n_a, sample_time = 24, 3, 0.5
    action_low, action_high, action_weight, target = -1.0, 1.0, 0.1, 0.5
    grid = Grid((Axis("x", 1.0, 24, periodic=False),))

    def __init__(self) -> None:
        self._B = 0.3 * humps(24, [0.15, 0.5, 0.85], 0.1)

    def initial_state(self, rng: np.random.Generator) -> Array:
        return cosines(rng, 24, 0.5)

    def rate(self, z: Array, a: Array) -> Array:
        moved = np.sign(a) * np.maximum(np.abs(a) - 0.1, 0.0)
        return joined(0.4 * second(z) - 0.05 * z + self._B @ moved)

    def operating_point(self) -> tuple[Array, Array]:
        """Outside of the dead zone, where the valves act."""
        return np.full(self.n_z, self.target), np.full(self.n_a, 0.2)


class Building(Process):
    """Eight rooms and their walls in a winter; radiator valves act on what the pipes carry."""

    n_z, n_a, sample_time, horizon = 17, 8, 1.0, 80
    action_low, action_high, action_target = 0.0, 1.0, 0.3
    action_weight = 0.1 * np.eye(8) + 0.02
    state_weight = joined(np.ones(8), np.zeros(9))
    target = joined(0.8 + 0.2 * (np.arange(8) % 2), np.zeros(9))

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(
            0.5 + 0.2 * rng.standard_normal(8), np.full(8, 0.3), 1.5 + 0.1 * rng.standard_normal()
        )

    def rate(self, z: Array, a: Array) -> Array:
        room, wall, pipe = z[:8], z[8:16], z[16]
        heat = 0.4 * a * (pipe - room)
        rooms = 0.15 * second(room) + 0.3 * (wall - room) + heat
        return joined(
            rooms, 0.1 * (room - wall) - 0.05 * wall, 0.3 * (1.8 - pipe) - 0.05 * heat.sum()
        )

    def operating_point(self) -> tuple[Array, Array]:
        """The settled state: the targets of walls and pipes have no weight, and are none."""
        a = np.full(self.n_a, self.action_target)
        return self.settled(joined(np.full(16, 0.5), 1.5), a), a


class CurrentProfile(Process):
    """The current in 20 shells of a plasma: the actuators heat it, which makes it conduct."""

    n_z, n_a, sample_time, substeps = 20, 3, 0.5, 8
    grid = Grid((Axis("r", 1.0, 20, periodic=False),))
    action_low, action_high, action_weight = -0.5, 0.5, 0.5

    def __init__(self) -> None:
        self._B = 0.3 * humps(20, [0.1, 0.4, 0.75], 0.12)
        self.target = self.settled(np.linspace(1.0, 0.2, 20), np.zeros(3))

    def initial_state(self, rng: np.random.Generator) -> Array:
        return joined(self.target + cosines(rng, 20, 0.25))

    def rate(self, z: Array, a: Array) -> Array:
        edge = np.arange(1, 20) / 20
        resistivity = 0.6 * np.exp(-0.8 * (self._B @ a))[1:] * (0.3 + edge**2)
        flux = np.concatenate([[0.0], edge * resistivity * np.diff(z), [1.5 * (0.1 - z[-1])]])
        return np.diff(flux) / cells(20) * 1.0 + self._B @ a + 0.02 * (1.0 - z)
