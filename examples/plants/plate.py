# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A reacting plate between walls: u_t = D (u_xx + u_yy) + r u - u^3 + sum_j Phi_j(x, y) a_j.

No flux through the walls. Finite volumes on nx by ny cells; a step of time is implicit in the
diffusion, whose sparse matrix is factorised once, and explicit in the reaction. u = 0 is unstable for
r > 0: without control the plate goes to u = sqrt(r) or -sqrt(r).
"""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

import pdeloop


def second_difference(n: int, spacing: float) -> sparse.spmatrix:
    """u_xx at the centres of n cells, without flux through the first and last face."""
    diagonal = -2.0 * np.ones(n)
    diagonal[[0, -1]] = -1.0
    return sparse.diags([np.ones(n - 1), diagonal, np.ones(n - 1)], [-1, 0, 1]) / spacing**2


class Plate(pdeloop.Dynamics):
    """To be held at u = 0 by four heaters."""

    horizon, sample_time = 50, 0.1
    n_a, action_weight, state_weight = 4, 0.1, 0.1

    def __init__(self, nx: int = 24, ny: int = 16, diffusivity: float = 0.05, rate: float = 1.0):
        walls = {"periodic": False, "walls": False}
        y, x = pdeloop.Axis("y", 1.0, ny, **walls), pdeloop.Axis("x", 1.5, nx, **walls)
        self.grid, self.rate, self.dt = pdeloop.Grid((y, x)), rate, self.sample_time / 5
        laplacian = sparse.kronsum(
            second_difference(nx, x.spacing), second_difference(ny, y.spacing)
        )
        self.solve = splu(
            sparse.csc_matrix(sparse.eye(nx * ny) - self.dt * diffusivity * laplacian)
        ).solve
        centres = [(0.25, 0.375), (0.25, 1.125), (0.75, 0.375), (0.75, 1.125)]
        Y, X = np.meshgrid(y.points, x.points, indexing="ij")
        heaters = [np.exp(-((X - cx) ** 2 + (Y - cy) ** 2) / (2 * 0.15**2)) for cy, cx in centres]
        self.supports = np.stack([heater.ravel() for heater in heaters], axis=1)
        waves = [
            np.cos(i * np.pi * X / 1.5) * np.cos(j * np.pi * Y) for i in (0, 1) for j in (0, 1)
        ]
        self.waves = np.stack([wave.ravel() for wave in waves])

    def initial_state(self, rng):
        return (rng.uniform(-0.5, 0.5, 4)[:, None] * self.waves).sum(axis=0)

    def step(self, z, a):
        heat = (self.supports * a).sum(axis=1)
        for _ in range(5):
            z = self.solve(z + self.dt * (self.rate * z - z**3 + heat))
        return z
