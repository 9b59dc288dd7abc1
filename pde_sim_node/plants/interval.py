# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One dimension with walls: heat, convection, reaction and Burgers on [0, L].

    u_t = D u_xx - c u_x - s u u_x + r u - b u^3 + sum_j Phi_j(x) a_j(t)

with alpha u + beta du/dn = g at each end, n outwards: "dirichlet" is u = g, "neumann" du/dn = g and
"robin" h u + du/dn = g. An input through a wall is its g; the g of other walls is 0.

Nodes x_i = i L / (n - 1), the walls among them; central differences, with a node beyond the wall
eliminated where a derivative is given there. Crank-Nicolson for the linear part, Heun for the rest:
second order in space and time.

References
----------
LeVeque, "Finite Difference Methods for Ordinary and Partial Differential Equations", SIAM 2007,
chapters 2 and 9.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from loop_interfaces.arrays import Array
from loop_interfaces.grid import Grid
from pde_sim_node.arguments import internal_steps, positive, whole
from pde_sim_node.dynamics import Dynamics

Wall = Literal["dirichlet", "neumann", "robin"]
Input = Literal["inside", "left", "right", "both"]


class Interval(Dynamics):
    """A field between two walls, with inputs inside or through a wall.

    Parameters
    ----------
    points
        Nodes n, the walls among them; good values: 51 to 201.
    length
        L.
    diffusivity, advection, steepening
        D > 0, c and s.
    growth, saturation
        r and b. With walls at u = 0 a uniform growth is unstable beyond D (pi/L)^2.
    left, right
        "dirichlet", "neumann" or "robin".
    transfer
        h of a wall that is "robin".
    inputs
        "inside": n_a actuators of Gaussian shape; "left", "right" or "both": through walls.
    actuators
        n_a of inputs inside.
    rms
        Root mean square of the coefficients of the initial fields' four lowest waves.
    step_time
        Internal time step; a sample_time of 0.05 is a whole multiple of it.

    Raises
    ------
    ValueError
        A value is out of its range; the message names it.
    """

    sample_time = 0.05

    def __init__(
        self,
        points: int = 65,
        length: float = 1.0,
        diffusivity: float = 0.05,
        advection: float = 0.0,
        steepening: float = 0.0,
        growth: float = 1.0,
        saturation: float = 0.0,
        left: str = "dirichlet",
        right: str = "dirichlet",
        transfer: float = 1.0,
        inputs: str = "inside",
        actuators: int = 3,
        rms: float = 0.5,
        step_time: float = 0.01,
    ) -> None:
        for name, given, known in (
            *(("left", left, Wall), ("right", right, Wall)),
            ("inputs", inputs, Input),
        ):
            if given not in get_args(known):
                raise ValueError(
                    f"{name} must be one of {', '.join(get_args(known))}, got {given!r}"
                )
        n = whole("points", points, 5)
        self.grid = Grid.interval(positive("length", length), n, periodic=False)
        self.x, self.rms = self.grid.axes[0].points, rms
        self._walls = {0: left, n - 1: right}
        self._physics = (positive("diffusivity", diffusivity), advection, growth, transfer)
        self._steepening, self._saturation = steepening, saturation
        self._dt = positive("step_time", step_time)
        self._steps = internal_steps(self.sample_time, self._dt)
        self._place_inputs(inputs, actuators)
        from scipy.sparse import csc_matrix, eye  # which only some plants need
        from scipy.sparse.linalg import splu

        self._linear = self._operator()
        self._solve = splu(csc_matrix(eye(n) - 0.5 * self._dt * csc_matrix(self._linear))).solve
        self._waves = self._initial_waves()

    def __getstate__(self) -> dict[str, object]:
        """How it was made: a factorisation cannot be pickled."""
        return {"_given": getattr(self, "_given", ((), {}))}

    def __setstate__(self, state: dict[str, tuple[tuple[object, ...], dict[str, object]]]) -> None:
        """Made again."""
        vars(self).update(state)
        arguments, named = state["_given"]
        self.__init__(*arguments, **named)  # type: ignore[misc]

    def _place_inputs(self, inputs: str, actuators: int) -> None:
        """Phi, and how an action enters at the walls."""
        n, last = len(self.x), len(self.x) - 1
        driven = {"inside": [], "left": [0], "right": [last], "both": [0, last]}[inputs]
        self.n_a = len(driven) or whole("actuators", actuators, 1)
        self.supports = np.zeros((n, self.n_a))
        self._driven = dict(zip(driven, range(self.n_a), strict=False))
        if not driven:
            centres = (np.arange(self.n_a) + 0.5) / self.n_a * self.x[-1]
            width = 0.25 * self.x[-1] / self.n_a
            self.supports = np.exp(-0.5 * ((self.x[:, None] - centres) / width) ** 2)
        for node, j in self._driven.items():
            self.supports[node, j] = 1.0
        self._inside = self.supports * (not driven)

    def _operator(self) -> Array:
        """The matrix of D u_xx - c u_x + r u; a row of a wall where u is given is zero."""
        D, c, r, h = self._physics
        n, dx = len(self.x), float(self.x[1])
        below, above = D / dx**2 + c / (2 * dx), D / dx**2 - c / (2 * dx)
        A = np.diag(np.full(n, r - 2 * D / dx**2))
        A += np.diag(np.full(n - 1, below), -1) + np.diag(np.full(n - 1, above), 1)
        self._flux = {}
        for node, wall in self._walls.items():
            inner, beyond = (1, below) if node == 0 else (n - 2, above)
            if wall == "dirichlet":
                A[node] = 0.0
                continue
            A[node, inner] += beyond  # u beyond the wall is that inside of it + 2 dx (g - h u)
            A[node, node] -= 2 * dx * beyond * (h if wall == "robin" else 0.0)
            self._flux[node] = 2 * dx * beyond
        return A

    def _initial_waves(self) -> Array:
        """The four lowest waves that are zero where u is given, and flat where it is not."""
        x, (left, right) = self.x / self.x[-1], (w == "dirichlet" for w in self._walls.values())
        shift = 0.5 if left != right else float(left)
        numbers = np.arange(4)[:, None] + shift
        waves: Array = np.sin(np.pi * numbers * x) if left else np.cos(np.pi * numbers * x)
        return waves

    def initial_state(self, rng: np.random.Generator) -> Array:
        """A random sum of the four lowest waves."""
        return self.held(self.rms / 2 * (rng.standard_normal(4)[:, None] * self._waves).sum(axis=0))

    def mean_state(self) -> Array:
        """The lowest wave, of the size that its coefficient has in the root mean square."""
        return self.held(self.rms / 2 * self._waves[0])

    def held(self, u: Array, a: Array | None = None) -> Array:
        """A field with the values that are given at its walls, in place."""
        for node, wall in self._walls.items():
            if wall == "dirichlet":
                u[node] = 0.0 if a is None or node not in self._driven else a[self._driven[node]]
        return u

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        forcing = (self._inside * a).sum(axis=1)
        for node, flux in self._flux.items():
            if node in self._driven:
                forcing[node] += flux * a[self._driven[node]]
        u, dt = self.held(z.copy(), a), self._dt
        for _ in range(self._steps):
            base = u + 0.5 * dt * (self._linear @ u) + dt * forcing
            first = self._rest(u)
            guess = self.held(self._solve(base + dt * first), a)
            u = self.held(self._solve(base + 0.5 * dt * (first + self._rest(guess))), a)
        return u

    def _rest(self, u: Array) -> Array:
        """-s u u_x - b u^3, in the conservative form inside and one-sided at the walls."""
        rest = -self._saturation * u**3
        if self._steepening:
            rest -= self._steepening * u * np.gradient(u, float(self.x[1]), edge_order=2)
        for node, wall in self._walls.items():
            if wall == "dirichlet":
                rest[node] = 0.0
        return rest

    def refined(self) -> Interval:
        """With half the internal time step."""
        arguments, named = getattr(self, "_given", ((), {}))
        return Interval(*arguments, **{**named, "step_time": self._dt / 2})
