# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Rayleigh-Bénard convection in a square, controlled by the temperatures of its lower wall.

    u_t + div(u u) = -grad p + sqrt(Pr/Ra) lap u + T e_y,    div u = 0
    T_t + div(u T) = lap T / sqrt(Pr Ra)

No slip; adiabatic sides; T = -1/2 on the upper wall and 1/2 + a_j on ten equal parts of the lower one.
Actions are made to have mean zero and then divided by max(1, max|a| / bound), as in beacon's task
`rayleigh-v0`. The conducting state u = 0, T = 1/2 - y must be held; above Ra = 2585 it is unstable. An
episode begins with the convection that develops without control.

The scheme is that of `buoyant_flow` on n x n cells with Euler's time steps: first order in time, second
in space.

References
----------
Viquerat, Hachem, "Beacon, a lightweight deep reinforcement learning benchmark library for flow
control", 2023. Ouertatani et al., "Numerical simulation of two-dimensional Rayleigh-Bénard convection
in an enclosure", C. R. Mécanique 336, 2008.
"""

from __future__ import annotations

import math

import numpy as np

from pde_sim_node.arguments import positive, whole
from pde_sim_node.dynamics import Dynamics, arguments_of
from pde_sim_node.plants.buoyant_flow import Cells, flow
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Axis, Grid

_STABLE = 0.8
"""Time step as a share of the limit dx^2 / 4 kappa of the explicit diffusion."""
_STARTED = 100.0
"""Time in which convection develops from a roll of the size of the box."""


class Convection(Dynamics):
    """A fluid heated from below, to be kept at rest.

    Parameters
    ----------
    cells
        n of each direction, a multiple of the number of heaters.
    rayleigh, prandtl
        Ra and Pr.
    heaters
        n_a.
    bound
        Largest change of a heater's temperature.
    action_cost
        R.
    steps
        T.
    refinement
        Time steps in place of one that is stable.

    Raises
    ------
    ValueError
        A value is out of its range; the message names it.
    """

    sample_time, batched = 2.0, True
    grid: Grid

    def __init__(
        self,
        cells: int = 50,
        rayleigh: float = 1e4,
        prandtl: float = 0.71,
        heaters: int = 10,
        bound: float = 0.75,
        action_cost: float = 0.01,
        steps: int = 100,
        refinement: int = 1,
    ) -> None:
        n, self.n_a = whole("cells", cells, 4), whole("heaters", heaters, 1)
        if n % self.n_a:
            raise ValueError(f"cells must be a multiple of the {heaters} heaters, got {cells}")
        axes = (Axis(name, 1.0, n, periodic=False, walls=False, unit="") for name in "yx")
        self.grid = Grid(tuple(axes), ("T", "u", "v"))
        self.bound, self.horizon = positive("bound", bound), whole("steps", steps, 1)
        self.state_weight = 1.0 / n**2
        self.action_weight = positive("action_cost", action_cost)
        self.kappa = 1.0 / math.sqrt(positive("prandtl", prandtl) * positive("rayleigh", rayleigh))
        self.nu = prandtl * self.kappa
        self.refinement = whole("refinement", refinement, 1)
        limit = _STABLE / (4 * n**2 * max(self.kappa, self.nu))
        self.substeps = math.ceil(self.sample_time / limit) * self.refinement
        self._cells = Cells.of(np.full(n, 1.0 / n), n, 1.0 / n, periodic=False)
        y = self.grid.axes[0].points
        rest = np.zeros((3, n, n))
        rest[0] = 0.5 - y[:, None]
        self.target = rest.ravel()
        heated = np.zeros((3, n, n, self.n_a))
        for i in range(n):
            heated[0, 0, i, i * self.n_a // n] = 1.0
        self.supports = heated.reshape(-1, self.n_a)
        self._developed: Array | None = None

    def actuated(self, a: Array) -> Array:
        """Of mean zero, and none beyond the bound."""
        balanced = a - a.mean()
        taken: Array = balanced / max(1.0, float(np.abs(balanced).max()) / self.bound)
        return taken

    def initial_state(self, rng: np.random.Generator) -> Array:
        """The convection that has developed without control."""
        return self.mean_state()

    def mean_state(self) -> Array:
        """The same."""
        if self._developed is None:
            n, points = self.grid.shape[0], self.grid.axes[0].points
            z = self.target.reshape(3, n, n).copy()
            z[0] += 0.3 * np.sin(np.pi * points)[:, None] * np.cos(np.pi * points)
            z = z.reshape(1, -1)
            for _ in range(round(_STARTED / self.sample_time)):
                z = self.step(z, np.zeros((1, self.n_a)))
            self._developed = z[0]
        return self._developed.copy()

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        fields = self.grid.fields(z).copy()
        below = np.repeat(0.5 + a, self.grid.shape[1] // self.n_a, axis=1)
        dt = self.sample_time / self.substeps
        for m in range(len(z)):
            flow(fields[m], below[m], self.kappa, self.nu, dt, self.substeps, 0.0, *self._cells)
        return fields.reshape(len(z), -1)

    def nusselt(self, z: Array) -> Array:
        """Nu of states (..., n_z): the heat through the lower wall, 1 where it is only conducted."""
        lowest, dy = self.grid.fields(z)[..., 0, 0, :], self.grid.axes[0].spacing
        found: Array = np.mean(0.5 - lowest, axis=-1) / (dy / 2)
        return found

    def refined(self) -> Convection:
        """With half the internal time step."""
        return type(self)(**{**arguments_of(self), "refinement": 2 * self.refinement})
