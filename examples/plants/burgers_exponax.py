# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant of exponax, a solver in JAX: Burgers' equation, u_t + u u_x = nu u_xx + sum_j Phi_j a_j.

pip install exponax jax. JAX differentiates the solver: `pull_back` is its transposed derivative, with
which `pdeloop.Gradients` gives exact gradients of a whole episode.
"""

import exponax
import jax
import jax.numpy as jnp
import numpy as np

import pdeloop

jax.config.update("jax_enable_x64", True)


class Burgers(pdeloop.Dynamics):
    """To be brought to rest by four actuators."""

    n_a, horizon, sample_time, action_weight = 4, 40, 0.05, 0.1

    def __init__(self, points: int = 64, viscosity: float = 0.01):
        self.grid = pdeloop.Grid.interval(1.0, points)
        self.steps = 5
        dt = self.sample_time / self.steps
        self.stepper = exponax.stepper.Burgers(1, 1.0, points, dt, diffusivity=viscosity)
        x = np.arange(points) / points
        far = np.abs(x[:, None] - (np.arange(4) + 0.5) / 4)
        self.supports = np.exp(-0.5 * (np.minimum(far, 1 - far) / 0.06) ** 2)
        self.waves = np.stack([f(2 * np.pi * k * x) for k in (1, 2) for f in (np.cos, np.sin)])

        def advance(z, a):
            force = dt * (jnp.asarray(self.supports) @ a)
            for _ in range(self.steps):
                z = self.stepper((z + 0.5 * force)[None])[0] + 0.5 * force
            return z

        self.advance = jax.jit(advance)
        self.transposed = jax.jit(lambda z, a, y: jax.vjp(advance, z, a)[1](y))

    def initial_state(self, rng):
        return 0.5 * rng.standard_normal(4) @ self.waves

    def step(self, z, a):
        return np.asarray(self.advance(z, a))

    def pull_back(self, z, a, y):
        on_z, on_a = self.transposed(z, a, y)
        return np.asarray(on_z), np.asarray(on_a)
