# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Rayleigh-Bénard convection in a periodic layer, as published with FluidGym.

    u_t + div(u u) = -grad p + sqrt(Pr/Ra) lap u + T e_y,    div u = 0
    T_t + div(u T) = lap T / sqrt(Pr Ra)

The layer has height 1 and length pi. No slip; T = -1/2 on the upper wall, which is the source's T less
1/2, and 1/2 + b_j on equal parts of the lower one, where the first cell of each has the mean of b_j and
the one before. As in the source b = bound max(-1, min(1, a - mean a)), element by element, so that the
mean of b need not be 0. The flow is to transfer little heat. As d/dt <u.u>/2 = <v T> - nu <|grad u|^2>,
Nu = 1 + sqrt(Ra Pr) <v T> is 1 + Pr <|grad u|^2> in the mean over long times; the cost is <u.u>.

The source's grid, uniform in x, with heights that grow by 2 % from row to row up to the middle. It is
staggered; the scheme is that of `buoyant_flow` with Adams and Bashforth's time steps, the first of an
action being Euler's: second order in time and space.

References
----------
FluidGym (github.com/safe-autonomous-systems/fluidgym), `RBC2D-easy-v0`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pde_sim_node.arguments import positive, whole
from pde_sim_node.dynamics import Dynamics, arguments_of
from pde_sim_node.plants.buoyant_flow import Cells, flow
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Axis, Grid

_GROWTH = 1.02
"""From the height of a row to the next, of 61; with others, the same from a wall to the middle."""
_ROWS = 61
FLOWS = 10
"""Developed flows in a set: the first begins the episodes."""
_DEVELOPING, _VARIES = 283.0, 0.15
"""Time in which a flow develops, and the relative standard deviation of it."""
_FIRST_NOISE, _NOISE = 0.1, 0.05
"""Standard deviation of the noise on the temperatures that a flow develops from; of all other noise."""
_SENSORS = 4
"""Of a height, above each heater."""
_HEIGHTS = (np.array([5, 14, 24, 33, 43, 52, 62, 71]) + 0.5) / 76
"""Those of sensors."""
_STABLE, _FAST = 0.8, 1.0
"""Time step as a share of the limit of the explicit diffusion, and of the time a velocity of 1, twice
the largest one without control, takes to cross a cell."""


class ConvectionLayer(Dynamics):
    """A fluid heated from below, which is to move, and thereby transfer heat, as little as it can.

    Parameters
    ----------
    columns, rows
        Cells in x, a multiple of four times the heaters, and in y.
    rayleigh, prandtl
        Ra and Pr.
    heaters
        n_a.
    bound
        Change of a heater's temperature at an action that is 1 above the mean.
    action_cost
        R; Q is that of the mean square of the velocity.
    steps
        T.
    refinement
        Time steps in place of one that is stable.

    Raises
    ------
    ValueError
        A value is out of its range; the message names it.
    """

    sample_time, batched = 1.0, True
    action_low, action_high = -1.0, 1.0
    grid: Grid

    def __init__(
        self,
        columns: int = 96,
        rows: int = 61,
        rayleigh: float = 8e4,
        prandtl: float = 0.7,
        heaters: int = 12,
        bound: float = 0.75,
        action_cost: float = 1e-4,
        steps: int = 200,
        refinement: int = 1,
    ) -> None:
        nx, ny = whole("columns", columns, 4), whole("rows", rows, 4)
        self.n_a = whole("heaters", heaters, 2)
        if nx % (_SENSORS * self.n_a):
            least = _SENSORS * self.n_a
            raise ValueError(
                f"columns must be a multiple of {least}, the sensors beside each other, got {columns}"
            )
        axes = (
            Axis("y", 1.0, ny, periodic=False, walls=False, unit=""),
            Axis("x", math.pi, nx, unit=""),
        )
        self.grid = Grid(axes, ("T", "u", "v"))
        self.bound = positive("bound", bound)
        self.action_weight = positive("action_cost", action_cost)
        self.horizon, self.refinement = whole("steps", steps, 1), whole("refinement", refinement, 1)
        self.kappa = 1.0 / math.sqrt(positive("prandtl", prandtl) * positive("rayleigh", rayleigh))
        self.nu = prandtl * self.kappa
        from_wall = np.minimum(np.arange(ny), np.arange(ny)[::-1])
        heights = _GROWTH ** (_ROWS / ny * from_wall)
        heights /= heights.sum()
        self._cells = Cells.of(heights, nx, math.pi / nx, periodic=True)
        # Diffusion leaves the scheme of Adams and Bashforth half the time step of Euler's.
        width = 1.0 / (heights[0] ** -2 + (nx / math.pi) ** 2)
        limit = min(_STABLE * width / (4 * max(self.kappa, self.nu)), _FAST * math.pi / nx)
        self.substeps = math.ceil(self.sample_time / limit) * self.refinement
        self.heights, y = heights, np.cumsum(heights) - 0.5 * heights
        rest = np.zeros((3, ny, nx))
        rest[0] = (0.5 - y)[:, None]
        self.target = rest.ravel()
        weights = np.zeros((3, ny, nx))
        weights[1:] = heights[:, None] / nx
        self.state_weight = weights.ravel()
        shapes = np.zeros((3, ny, nx, self.n_a))
        shapes[0, 0] = self._below(self.bound * np.eye(self.n_a)).T
        self.supports = shapes.reshape(-1, self.n_a)
        self._at_sensors = np.array([np.interp(_HEIGHTS, y, row) for row in np.eye(ny)]).T
        self._flows: dict[int, Array] = {}

    def heated(self, a: Array) -> Array:
        """b of actions (M, n_a)."""
        b: Array = self.bound * np.clip(a - a.mean(axis=1, keepdims=True), -1.0, 1.0)
        return b

    def _below(self, b: Array) -> Array:
        """Changes (M, n_x) of the temperature of the lower wall."""
        width = self.grid.shape[1] // self.n_a
        wall = np.repeat(b, width, axis=1)
        wall[:, ::width] = 0.5 * (b + np.roll(b, 1, axis=1))
        return wall

    def initial_state(self, rng: np.random.Generator) -> Array:
        """A developed flow, mirrored or not, shifted, with noise, after 1 to 2 units of time."""
        fields = self.developed(int(rng.integers(FLOWS))).reshape(3, *self.grid.shape)
        if rng.random() < 0.5:
            fields = mirrored(fields)
        fields = np.roll(fields, rng.integers(self.grid.shape[1]), axis=2)
        fields += _NOISE * rng.standard_normal(fields.shape)
        begun = self._begun(fields)
        self._advance(begun, round(rng.uniform(1.0, 2.0) * self.substeps))
        return begun.ravel()

    def mean_state(self) -> Array:
        """The first developed flow, as the mean of them is no flow."""
        return self.developed(0)

    def developed(self, number: int) -> Array:
        """A flow that has developed without control, from noise of its own."""
        if number not in self._flows:
            rng = np.random.default_rng(number)
            fields = self.target.reshape(3, *self.grid.shape).copy()
            drawn = rng.standard_normal(fields.shape)
            fields += np.array([_FIRST_NOISE, _NOISE, _NOISE])[:, None, None] * drawn
            fields, time = self._begun(fields), _DEVELOPING * (1 + _VARIES * rng.standard_normal())
            self._advance(fields, round(time * self.substeps))
            self._flows[number] = fields.ravel()
        return self._flows[number].copy()

    def _begun(self, fields: Array) -> Array:
        """With temperatures between those of the walls, and no flow through the lower one."""
        fields[0] = np.clip(fields[0], -0.5, 0.5)
        fields[2, 0] = 0.0
        return fields

    def _advance(self, fields: Array, steps: int, wall: Any = 0.0) -> None:
        """Time steps of fields (3, n_y, n_x), in place, with changes of the wall's temperature."""
        dt, below = self.sample_time / self.substeps, np.full(fields.shape[2], 0.5) + wall
        flow(fields, below, self.kappa, self.nu, dt, steps, 0.5, *self._cells)

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        new, walls = self.grid.fields(z).copy(), self._below(self.heated(a))
        for fields, wall in zip(new, walls, strict=True):
            self._advance(fields, self.substeps, wall)
        return new.reshape(len(z), -1)

    def nusselt(self, z: Array) -> Array:
        """Nu of states (..., n_z): 1 + sqrt(Ra Pr) <v T>, the mean over the layer."""
        T, _, v = np.moveaxis(self.grid.fields(z), -3, 0)
        apart = 0.5 * (self.heights[1:] + self.heights[:-1])
        risen = 0.5 * v[..., 1:, :] * (T[..., 1:, :] + T[..., :-1, :])
        found: Array = 1.0 + (apart[:, None] * risen).sum(axis=-2).mean(axis=-1) / self.kappa
        return found

    def readings(self, z: Array) -> Array:
        """T less that of conduction, u and v at the sensors: (..., n_z) -> (..., 3, 8, 4 n_a)."""
        T, u, v = np.moveaxis(self.grid.fields(z - self.target), -3, 0)
        above = np.zeros_like(v)
        above[..., :-1, :] = v[..., 1:, :]
        centred = np.stack([T, 0.5 * (u + np.roll(u, -1, axis=-1)), 0.5 * (v + above)], axis=-3)
        columns = centred[..., :: self.grid.shape[1] // (_SENSORS * self.n_a)]
        found: Array = self._at_sensors @ columns
        return found

    def refined(self) -> ConvectionLayer:
        """With half the internal time step."""
        return type(self)(**{**arguments_of(self), "refinement": 2 * self.refinement})


def mirrored(fields: Array) -> Array:
    """T, u, v (3, n_y, n_x) reflected about the first cell, which two heaters share."""
    T, u, v = fields[:, :, ::-1]
    return np.stack([np.roll(T, 1, axis=1), -np.roll(u, 2, axis=1), np.roll(v, 1, axis=1)])
