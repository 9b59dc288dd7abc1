# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A driven cavity: incompressible flow in a square whose lid is moved.

    u_t + (u . grad) u = -grad p + nu lap u,    div u = 0    on [0, 1]^2,    u = (a, 0) on the lid

No slip on the other walls, corners at rest. The task of PDEControlGym's NavierStokes: begin at rest and
follow the flow under a lid that falls from 4 to 2, with an action near 2. With n = 21^2 points, states
after the step, and Q = I / 2n, R = 0.05, the published return is minus the sum of the stage costs.

Collocated points i / (n - 1), the walls among them; explicit Euler with central differences, then a
projection: the five-point Poisson equation with zero-gradient walls, solved by cosine transforms.
First order in time, second in space away from the walls.

References
----------
Bhan, Bian, Krstic, Shi, "PDE Control Gym", L4DC 2024. Chorin, "Numerical solution of the Navier-Stokes
equations", Math. Comp. 22, 1968.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pde_sim_node.arguments import internal_steps, positive, whole
from pde_sim_node.dynamics import Dynamics
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Axis, Grid


class Cavity(Dynamics):
    """A flow that is to follow another one, under the control of the lid's velocity.

    Parameters
    ----------
    points
        Of each axis, the walls among them.
    viscosity
        nu.
    steps
        T; the lid of the flow to be followed falls linearly from `first` to `last` over them.
    first, last
        Its velocities.
    action_cost
        R.
    wanted_action
        a_r.
    rms
        Root mean square of a random flow at the start; 0: at rest.
    step_time
        Internal time step; a sample_time of 0.001 is a whole multiple of it.

    Raises
    ------
    ValueError
        A value is out of its range; the message names it.
    """

    n_a, sample_time, batched = 1, 1e-3, True
    grid: Grid

    def __init__(
        self,
        points: int = 21,
        viscosity: float = 0.1,
        steps: int = 199,
        first: float = 4.0,
        last: float = 2.0,
        action_cost: float = 0.05,
        wanted_action: float = 2.0,
        rms: float = 0.0,
        step_time: float = 1e-3,
    ) -> None:
        n = whole("points", points, 5)
        self.grid = Grid(tuple(Axis(name, 1.0, n, periodic=False) for name in "yx"), ("u", "v"))
        self.viscosity, self.rms = positive("viscosity", viscosity), rms
        self.dt, self.dx = positive("step_time", step_time), 1.0 / (n - 1)
        self.substeps = internal_steps(self.sample_time, self.dt)
        waves = 2.0 * (np.cos(np.pi * np.arange(n - 2) / (n - 2)) - 1.0)
        self._symbol = (waves[:, None] + waves) / self.dx**2
        self._symbol[0, 0] = 1.0  # of the mean, which a pressure does not have
        self.horizon = whole("steps", steps, 1)
        self.action_weight, self.action_target = positive("action_cost", action_cost), wanted_action
        self.state_weight = 0.5 / n**2
        # The cost of the state after the last step counts like all others.
        self.terminal_weight = self.state_weight
        self.lid = np.linspace(first, last, self.horizon)
        self.target = self._followed()
        lid = np.zeros((2, n, n))
        lid[0, -1, 1:-1] = 1.0
        self.supports = lid.reshape(-1, 1)

    def _followed(self) -> Array:
        """The flow under `lid`, one row for each state (T + 1, n_z)."""
        z = np.zeros((1, self.grid.size))
        rows = [z[0]]
        for a in self.lid:
            z = self.step(z, np.array([[a]]))
            rows.append(z[0])
        return np.array(rows)

    def initial_state(self, rng: np.random.Generator) -> Array:
        """At rest, or a random sum of nine vortices that are slow at the walls."""
        n = self.grid.shape[0]
        if not self.rms:
            return np.zeros(self.grid.size)
        s = np.sin(np.pi * np.arange(1, 4)[:, None] * np.linspace(0.0, 1.0, n)) ** 2
        stream = np.einsum("ij,iy,jx->yx", rng.standard_normal((3, 3)), s, s)
        flow = np.stack(np.gradient(stream, self.dx) * np.array([1.0, -1.0])[:, None, None])
        flow[:, [0, -1]] = flow[:, :, [0, -1]] = 0.0
        scaled: Array = self.rms * flow / np.sqrt(np.mean(flow**2))
        return scaled

    def mean_state(self) -> Array:
        """At rest."""
        return np.zeros(self.grid.size)

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        u, v = (part.copy() for part in self.grid.fields(z).swapaxes(0, 1))
        for _ in range(self.substeps):
            u, v = self._substep(u, v, a)
        return np.stack([u, v], axis=1).reshape(len(z), -1)

    def hold_walls(self, u: Array, v: Array, a: Array) -> None:
        """The velocities at the walls, in place: u, v (M, n, n), a (M, 1)."""
        for part in (u, v):
            part[:, [0, -1]] = part[:, :, [0, -1]] = 0.0
        u[:, -1, 1:-1] = a

    def _substep(self, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        inside = np.s_[:, 1:-1, 1:-1]
        after = []
        for part in (u, v):
            moved = part.copy()
            rate = self.viscosity * _laplacian(part, self.dx)
            rate -= u[inside] * _along_x(part, self.dx) + v[inside] * _along_y(part, self.dx)
            moved[inside] += self.dt * rate
            after.append(moved)
        u, v = after
        self.hold_walls(u, v, a)
        p = self._pressure(_along_x(u, self.dx) + _along_y(v, self.dx))
        u[inside] -= _along_x(p, self.dx)
        v[inside] -= _along_y(p, self.dx)
        self.hold_walls(u, v, a)
        return u, v

    def _pressure(self, divergence: Array) -> Array:
        """dt p with lap(dt p) = divergence inside, and the value next to it at each wall."""
        from scipy.fft import dctn, idctn  # which only some plants need

        transform: Any = dctn(divergence, axes=(1, 2), norm="ortho") / self._symbol
        transform[:, 0, 0] = 0.0
        inside = idctn(transform, axes=(1, 2), norm="ortho")
        return np.pad(inside, ((0, 0), (1, 1), (1, 1)), mode="edge")


def _laplacian(f: Array, dx: float) -> Array:
    around = f[:, 1:-1, :-2] + f[:, 1:-1, 2:] + f[:, :-2, 1:-1] + f[:, 2:, 1:-1]
    return (around - 4.0 * f[:, 1:-1, 1:-1]) / dx**2


def _along_x(f: Array, dx: float) -> Array:
    return (f[:, 1:-1, 2:] - f[:, 1:-1, :-2]) / (2.0 * dx)


def _along_y(f: Array, dx: float) -> Array:
    return (f[:, 2:, 1:-1] - f[:, :-2, 1:-1]) / (2.0 * dx)
