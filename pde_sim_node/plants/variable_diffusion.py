# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Diffusion with a coefficient that depends on the place, u_t = div(D grad u), on a rectangle.

Finite volumes: the flux D du/dn through each face between two cells by central differences, and at a
wall where u = 0 by the difference over half a cell. Crank-Nicolson in time, with one sparse LU
factorisation. Second order in space and time.

References
----------
LeVeque, "Finite Volume Methods for Hyperbolic Problems", Cambridge 2002, section 4.2 (fluxes of
diffusion); Hundsdorfer, Verwer, "Numerical Solution of Time-Dependent Advection-Diffusion-Reaction
Equations", Springer 2003, chapter I.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from pde_sim_node.arguments import Coefficient, values_at
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Grid


class VariableDiffusion:
    """Steps of diffusion of one component.

    Parameters
    ----------
    grid
        Of two axes (y, x), with unknowns at the centres of cells, or at i L / n where it is periodic.
    walls
        "periodic", "neumann" or "dirichlet", on all sides.
    diffusivity
        D > 0: its values at the points, or a function of x and y.
    dt
        Time step.
    """

    def __init__(self, grid: Grid, walls: str, diffusivity: Coefficient, dt: float) -> None:
        self._walls, self._dt = walls, dt
        self._counts = [axis.size for axis in grid.axes]
        self._widths = [axis.length / axis.size for axis in grid.axes]
        points = [axis.points for axis in grid.axes]
        y, x = np.meshgrid(*points, indexing="ij")
        self.at_points = values_at("diffusivity", diffusivity, x, y)
        self._faces = [self._through(axis, points, diffusivity) for axis in range(2)]
        least = min(float(part.min()) for part in (self.at_points, *self._faces))
        if not least > 0.0:
            raise ValueError(f"diffusivity must be positive, got {least:g} somewhere")

    def _through(self, axis: int, points: list[Array], diffusivity: Coefficient) -> Array:
        """D at the faces across an axis, one more than cells."""
        if callable(diffusivity):
            own = points[axis]
            shifted = np.append(own, own[-1] + self._widths[axis]) - 0.5 * self._widths[axis]
            y, x = np.meshgrid(
                *(shifted if i == axis else other for i, other in enumerate(points)), indexing="ij"
            )
            return values_at("diffusivity", diffusivity, x, y)
        D = np.moveaxis(self.at_points, axis, 0)
        inner = 0.5 * (D[1:] + D[:-1])
        if self._walls == "periodic":
            first = last = 0.5 * (D[:1] + D[-1:])
        else:  # linear extrapolation, which keeps the order
            first, last = 1.5 * D[:1] - 0.5 * D[1:2], 1.5 * D[-1:] - 0.5 * D[-2:-1]
        return np.moveaxis(np.concatenate([first, inner, last]), 0, axis)

    def step(self, u: Array) -> Array:
        """u (..., ny, nx) a time step later."""
        fields = u.reshape(-1, np.prod(self._counts))
        explicit, solve = self._solver
        # One after the other, so that a field's bits do not depend on the others.
        after = np.stack([solve(explicit @ field) for field in fields])
        return after.reshape(u.shape)

    def __getstate__(self) -> dict[str, object]:
        """Without the factorisation, which cannot be pickled."""
        return {name: value for name, value in vars(self).items() if name != "_solver"}

    @cached_property
    def _solver(self) -> tuple[Any, Callable[[Array], Array]]:
        """The matrix I + dt/2 L, and the solution with I - dt/2 L."""
        from scipy import sparse  # which only some plants need
        from scipy.sparse.linalg import splu

        ny, nx = self._counts
        L = sparse.csc_matrix((ny * nx, ny * nx))
        for axis, faces in enumerate(self._faces):
            n, h = self._counts[axis], self._widths[axis]
            slope = sparse.lil_matrix((n + 1, n))
            for face in range(1, n):
                slope[face, face - 1], slope[face, face] = -1.0 / h, 1.0 / h
            if self._walls == "periodic":
                for face in (0, n):
                    slope[face, n - 1], slope[face, 0] = -1.0 / h, 1.0 / h
            elif self._walls == "dirichlet":
                slope[0, 0], slope[n, n - 1] = 2.0 / h, -2.0 / h
            out = sparse.diags([-1.0 / h, 1.0 / h], [0, 1], shape=(n, n + 1))
            along = [sparse.eye(ny), sparse.eye(nx)]
            gradient, divergence = (
                sparse.kron(*(part if i == axis else along[i] for i in range(2)), format="csc")
                for part in (slope, out)
            )
            L = L + divergence @ sparse.diags(faces.ravel()) @ gradient
        eye = sparse.eye(ny * nx, format="csc")
        return (eye + 0.5 * self._dt * L).tocsr(), splu((eye - 0.5 * self._dt * L).tocsc()).solve
