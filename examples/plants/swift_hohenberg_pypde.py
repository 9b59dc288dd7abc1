# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant of py-pde: u_t = r u - (1 + lap)^2 u - u^3 + sum_j Phi_j a_j on a square between walls.

pip install py-pde. Fields, boundary conditions and operators are py-pde's; a step is what its explicit
stepper does, with the forcing added.
"""

import numpy as np
from pde import CartesianGrid, ScalarField

import pdeloop


class SwiftHohenberg(pdeloop.Dynamics):
    """Stripes that begin to grow are to be held down by four actuators."""

    n_a, horizon, sample_time, action_weight = 4, 20, 0.5, 0.1

    def __init__(self, points: int = 12, length: float = 12.0, rate: float = 0.3):
        y, x = (pdeloop.Axis(n, length, points, periodic=False, walls=False) for n in "yx")
        self.grid = pdeloop.Grid((y, x))
        self.domain = CartesianGrid([[0, length]] * 2, points, periodic=False)
        self.rate, self.steps = rate, 50
        Y, X = np.meshgrid(y.points, x.points, indexing="ij")
        centres = [
            (i, j) for i in (length / 4, 3 * length / 4) for j in (length / 4, 3 * length / 4)
        ]
        bumps = [np.exp(-((Y - cy) ** 2 + (X - cx) ** 2) / length) for cy, cx in centres]
        self.supports = np.stack([bump.ravel() for bump in bumps], axis=1)

    def initial_state(self, rng):
        return 0.3 * rng.standard_normal(4) @ self.supports.T

    def step(self, z, a):
        u = ScalarField(self.domain, z.reshape(self.grid.shape))
        forcing = (self.supports @ a).reshape(self.grid.shape)
        for _ in range(self.steps):
            bent = u.laplace("derivative", backend="scipy") + u
            rate = self.rate * u - bent.laplace("derivative", backend="scipy") - bent - u**3
            u = u + self.sample_time / self.steps * (rate + forcing)
        return u.data
