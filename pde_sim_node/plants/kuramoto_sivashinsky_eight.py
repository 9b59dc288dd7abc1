# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Kuramoto-Sivashinsky on a circle with eight bounded actuators: the plant of DA-RL.

    u_t + u u_x + u_xx + u_xxxx = sum_j a_j b_j(x),    L = 2 pi / sqrt(0.08) = 22.21

with b_j periodic Gaussians of peak 1 and standard deviation 0.1 L / 2 pi, L / n_a apart. Rest is
unstable; an episode begins on the attractor, which small random fields reach without control.

Pseudo-spectral without dealiasing, in three substeps of dt/3, dt/2 and dt from the beginning of a
step: the nonlinear part and the forcing at the substep before, the linear one by Crank-Nicolson. Second
order in time.

References
----------
Özalp, Nóvoa, Magri, "Real-time control of chaotic flows with data assimilation and reinforcement
learning", 2025 (github.com/MagriLab/DA-RL). Bucci et al., "Control of chaotic systems by deep
reinforcement learning", Proc. R. Soc. A 475, 2019.
"""

from __future__ import annotations

import math

import numpy as np

from pde_sim_node.arguments import positive, whole
from pde_sim_node.dynamics import Dynamics, arguments_of
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Grid


class KuramotoSivashinskyEight(Dynamics):
    """A chaotic field to be brought to rest.

    Parameters
    ----------
    points
        Of the circle, an even number.
    viscosity
        nu of the length L = 2 pi / sqrt(nu).
    actuators
        n_a.
    bound
        Largest magnitude of an action.
    action_cost
        R; Q is 1 / points.
    steps
        T.
    sample_time
        Of a step, in which an action is held.
    substeps
        Time steps in an action.
    burn_in
        Actions of zero from a small random field to the beginning of an episode.
    first
        Position of the first actuator as a share of L.

    Raises
    ------
    ValueError
        A value is out of its range; the message names it.
    """

    batched = True
    grid: Grid

    def __init__(
        self,
        points: int = 64,
        viscosity: float = 0.08,
        actuators: int = 8,
        bound: float = 1.0,
        action_cost: float = 0.03,
        steps: int = 1000,
        sample_time: float = 0.05,
        substeps: int = 1,
        burn_in: int = 1000,
        first: float = 0.0,
    ) -> None:
        n, self.n_a = whole("points", points, 8), whole("actuators", actuators, 1)
        if n % 2:
            raise ValueError(f"points must be even, got {n}")
        length = 2 * math.pi / math.sqrt(positive("viscosity", viscosity))
        self.grid = Grid.interval(length, n)
        self.action_high = positive("bound", bound)
        self.action_low = -self.action_high
        self.state_weight, self.action_weight = 1.0 / n, positive("action_cost", action_cost)
        self.horizon, self.substeps = whole("steps", steps, 1), whole("substeps", substeps, 1)
        self.burn_in = whole("burn_in", burn_in, 0)
        self.sample_time = positive("sample_time", sample_time)
        if not math.isfinite(first):
            raise ValueError(f"first must be a finite number, got {first!r}")
        x = self.grid.axes[0].points
        far = (x[:, None] - length * (np.arange(self.n_a) / self.n_a + first)) % length
        far = np.minimum(far, length - far)
        self.supports = np.exp(-0.5 * (far / (0.1 * length / (2 * math.pi))) ** 2)
        self._shapes = np.fft.rfft(self.supports, axis=0).T
        k = 2 * math.pi / length * np.arange(n // 2 + 1)
        self._slope, rate = -0.5j * k, k**2 - k**4
        self._slope[-1] = 0.0
        dt = self.sample_time / self.substeps
        self._parts = [
            (h, 1.0 + 0.5 * h * rate, 1.0 / (1.0 - 0.5 * h * rate)) for h in (dt / 3, dt / 2, dt)
        ]

    def initial_state(self, rng: np.random.Generator) -> Array:
        """A field of the attractor: what becomes of a small random one without control."""
        u = 0.01 * rng.standard_normal((1, self.grid.size))
        u -= u.mean()
        for _ in range(self.burn_in):
            u = self.step(u, np.zeros((1, self.n_a)))
        start: Array = u[0]
        return start

    def mean_state(self) -> Array:
        """One field of the attractor, as the mean of them is no field of it."""
        return self.initial_state(np.random.default_rng(0))

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        forcing = np.zeros((len(z), len(self._slope)), complex)
        for j in range(self.n_a):  # in this order for every batch
            forcing += a[:, j : j + 1] * self._shapes[j]
        for _ in range(self.substeps):
            start, u = np.fft.rfft(z), z
            for h, explicit, implicit in self._parts:
                pushed = h * (self._slope * np.fft.rfft(u * u) + forcing)
                u = np.fft.irfft((explicit * start + pushed) * implicit, self.grid.size)
            z = u
        return z

    def refined(self) -> KuramotoSivashinskyEight:
        """With half the internal time step."""
        return type(self)(**{**arguments_of(self), "substeps": 2 * self.substeps})
