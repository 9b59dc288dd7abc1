# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants given by a rate, dz/dt = r(z) + E E_a a, with exact derivatives of their Runge-Kutta step.

A training is told nothing of the derivatives; `benchmarks.bounds` works out limits with them.

References
----------
Hager, "Runge-Kutta methods in optimal control and the transformed adjoint system", Numerische
Mathematik 87, 2000 (the transposed derivative of a step, stage by stage).
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from pde_sim_node.dynamics import Dynamics
from pdeloop.messages.arrays import Array


class RatePlant(Dynamics):
    """A plant integrated by the classical Runge-Kutta method of fourth order, the action being held.

    Every method takes one state and action, or a batch of them.

    Attributes
    ----------
    substeps : int
        Equal internal steps of a sampling time.
    shapes : (n_a, n_f) array
        Force of each actuator; a force has as many numbers as the part of the state it acts on.
    """

    substeps: int
    shapes: Array

    @abstractmethod
    def rate(self, z: Array, force: Array) -> Array:
        """dz/dt."""

    @abstractmethod
    def pull_back_rate(self, z: Array, y: Array) -> tuple[Array, Array]:
        """(dr/dz)^T y and (dr/dforce)^T y."""

    def forced(self, a: Array) -> Array:
        """The force of an action."""
        return a @ self.shapes

    def step(self, z: Array, a: Array) -> Array:
        force, h = self.forced(a), self.sample_time / self.substeps
        for _ in range(self.substeps):
            z = z + h / 6 * self._weighted(self._stages(z, force, h)[1])
        return z

    def pull_back(self, z: Array, a: Array, y: Array) -> tuple[Array, Array]:
        force, h = self.forced(a), self.sample_time / self.substeps
        stages = []
        for _ in range(self.substeps):
            points, rates = self._stages(z, force, h)
            stages.append(points)
            z = z + h / 6 * self._weighted(rates)
        on_force = np.zeros_like(force)
        for points in reversed(stages):
            # Of the rate at each stage: its own weight in the step, and the next stage's point.
            on_z, on_point = y, np.zeros_like(y)
            for point, weight, reach in zip(
                reversed(points), (h / 6, h / 3, h / 3, h / 6), (0.0, h, h / 2, h / 2), strict=True
            ):
                on_point, forced = self.pull_back_rate(point, weight * y + reach * on_point)
                on_z = on_z + on_point
                on_force += forced
            y = on_z
        return y, on_force @ self.shapes.T

    def _stages(self, z: Array, force: Array, h: float) -> tuple[list[Array], list[Array]]:
        """The four points of an internal step, and the rates there."""
        points, rates = [z], [self.rate(z, force)]
        for reach in (h / 2, h / 2, h):
            points.append(z + reach * rates[-1])
            rates.append(self.rate(points[-1], force))
        return points, rates

    def _weighted(self, rates: list[Array]) -> Array:
        k1, k2, k3, k4 = rates
        total: Array = k1 + 2 * k2 + 2 * k3 + k4
        return total
