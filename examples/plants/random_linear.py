# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A random linear plant, z_{k+1} = A z_k + B a_k, of 64 states and 4 actuators."""

import numpy as np

import pdeloop


class RandomLinear(pdeloop.Dynamics):
    n_z, n_a, horizon = 64, 4, 40

    def __init__(self, radius: float = 1.0, seed: int = 0):
        rng = np.random.default_rng(seed)
        self.A = radius * rng.standard_normal((64, 64)) / 8  # eigenvalues fill a disc
        self.B = rng.standard_normal((64, 4)) / 2

    def initial_state(self, rng):
        return rng.standard_normal(64)

    def step(self, z, a):
        return self.A @ z + self.B @ a
