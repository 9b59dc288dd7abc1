# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One dimension with walls: heat, convection, reaction and Burgers on [0, L].

    u_t = (D u_x)_x - c u_x - s u u_x + r u - b u^3 + f + sum_j Phi_j(x) a_j(t)

with D, c, s, r, b and f numbers or functions of x, and alpha u + beta du/dn = g at each end, n
outwards: "dirichlet" is u = g, "neumann" du/dn = g and "robin" h u + du/dn = g. An input through a wall
is its g; the g of other walls is 0.

Nodes x_i = i L / (n - 1), the walls among them; central differences with D between the nodes, and a
node beyond the wall eliminated where a derivative is given there. Crank-Nicolson for the linear part,
Heun for the rest: second order in space and time.

References
----------
LeVeque, "Finite Difference Methods for Ordinary and Partial Differential Equations", SIAM 2007,
chapters 2 and 9.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np

from pde_sim_node.arguments import Coefficient, internal_steps, positive, values_at, whole
from pde_sim_node.dynamics import Dynamics
from pdeloop.messages.arrays import Array, float_array
from pdeloop.messages.grid import Grid

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
        D > 0, c and s, each a number, a function of x, or the values at the nodes.
    growth, saturation
        r and b, likewise. With walls at u = 0 a uniform growth is unstable beyond D (pi/L)^2.
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
    forcing
        f, likewise.
    shapes
        Phi of inputs inside: a function of x (n,) that gives (n, n_a), in place of Gaussians.

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
        diffusivity: Coefficient = 0.05,
        advection: Coefficient = 0.0,
        steepening: Coefficient = 0.0,
        growth: Coefficient = 1.0,
        saturation: Coefficient = 0.0,
        left: str = "dirichlet",
        right: str = "dirichlet",
        transfer: float = 1.0,
        inputs: str = "inside",
        actuators: int = 3,
        rms: float = 0.5,
        step_time: float = 0.01,
        forcing: Coefficient = 0.0,
        shapes: Callable[[Array], Array] | None = None,
    ) -> None:
        for name, given, known in (
            ("left", left, Wall),
            ("right", right, Wall),
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
        self._D = self._between(diffusivity)
        self._c, self._r = (
            values_at("advection", advection, self.x),
            values_at("growth", growth, self.x),
        )
        self._steepening = values_at("steepening", steepening, self.x)
        self._saturation = values_at("saturation", saturation, self.x)
        self._h, self._steady = transfer, values_at("forcing", forcing, self.x)
        self._dt = positive("step_time", step_time)
        self._steps = internal_steps(self.sample_time, self._dt)
        self._place_inputs(inputs, actuators, shapes)
        from scipy.sparse import csc_matrix, eye  # which only some plants need
        from scipy.sparse.linalg import splu

        self._linear = self._operator()
        self._solve = splu(csc_matrix(eye(n) - 0.5 * self._dt * csc_matrix(self._linear))).solve
        self._waves = self._initial_waves()

    def __getstate__(self) -> dict[str, object]:
        """The arguments it was made with, as a factorisation cannot be pickled."""
        return {"_given": getattr(self, "_given", ((), {}))}

    def __setstate__(self, state: dict[str, tuple[tuple[object, ...], dict[str, object]]]) -> None:
        """Made again."""
        vars(self).update(state)
        arguments, named = state["_given"]
        self.__init__(*arguments, **named)  # type: ignore[misc]

    def _between(self, diffusivity: Coefficient) -> Array:
        """D half-way to both neighbours of each node, (n + 1,); the first and the last are beyond."""
        x, at = self.x, values_at("diffusivity", diffusivity, self.x)
        middle = 0.5 * (x[1:] + x[:-1])
        inner = (
            values_at("diffusivity", diffusivity, middle)
            if callable(diffusivity)
            else 0.5 * (at[1:] + at[:-1])
        )
        if not (at.min() > 0.0 and inner.min() > 0.0):
            raise ValueError(
                f"diffusivity must be positive, got {min(at.min(), inner.min()):g} somewhere"
            )
        # Extrapolated linearly beyond the walls, which keeps the order.
        return np.concatenate([[2 * at[0] - inner[0]], inner, [2 * at[-1] - inner[-1]]])

    def _place_inputs(
        self, inputs: str, actuators: int, shapes: Callable[[Array], Array] | None
    ) -> None:
        """Phi, and how an action enters at the walls."""
        n, last = len(self.x), len(self.x) - 1
        driven = {"inside": [], "left": [0], "right": [last], "both": [0, last]}[inputs]
        self.n_a = len(driven) or whole("actuators", actuators, 1)
        if shapes is not None:
            given = float_array("shapes", shapes(self.x))
            if driven or given.ndim != 2 or len(given) != n or not np.isfinite(given).all():
                raise ValueError(
                    f"shapes must give {n} x n_a finite numbers for inputs inside, got an array of "
                    f"shape {given.shape} for inputs {inputs}"
                )
            self.n_a = given.shape[1]
        self.supports = np.zeros((n, self.n_a))
        self._driven = dict(zip(driven, range(self.n_a), strict=False))
        if shapes is not None:
            self.supports = given
        elif not driven:
            centres = (np.arange(self.n_a) + 0.5) / self.n_a * self.x[-1]
            width = 0.25 * self.x[-1] / self.n_a
            self.supports = np.exp(-0.5 * ((self.x[:, None] - centres) / width) ** 2)
        for node, j in self._driven.items():
            self.supports[node, j] = 1.0
        self._inside = self.supports * (not driven)
        for node, wall in self._walls.items():
            if wall == "dirichlet":  # where u is given, nothing forces it
                self._inside[node] = self._steady[node] = 0.0

    def _operator(self) -> Array:
        """The matrix of (D u_x)_x - c u_x + r u; a row of a wall where u is given is zero."""
        D, c, h = self._D, self._c, self._h
        n, dx = len(self.x), float(self.x[1])
        below, above = D[:-1] / dx**2 + c / (2 * dx), D[1:] / dx**2 - c / (2 * dx)
        A = np.diag(self._r - (D[:-1] + D[1:]) / dx**2)
        A += np.diag(below[1:], -1) + np.diag(above[:-1], 1)
        self._flux = {}
        for node, wall in self._walls.items():
            inner, beyond = (1, below[0]) if node == 0 else (n - 2, above[-1])
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
        forcing = (self._inside * a).sum(axis=1) + self._steady
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
        if self._steepening.any():
            rest -= self._steepening * u * np.gradient(u, float(self.x[1]), edge_order=2)
        for node, wall in self._walls.items():
            if wall == "dirichlet":
                rest[node] = 0.0
        return rest

    def refined(self) -> Interval:
        """With half the internal time step."""
        arguments, named = getattr(self, "_given", ((), {}))
        return Interval(*arguments, **{**named, "step_time": self._dt / 2})
