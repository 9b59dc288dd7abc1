# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Kuramoto-Sivashinsky on a circle with four bounded jets: the plant of Werner and Peitz.

    u_t = -u_xxxx - u_xx - (u^2)_x / 2 + sum_j a_j b_j(x),    L = 22

with b_j = exp(-(x - xi_j)^2 / 2 sigma^2) / sqrt(2 pi sigma), sigma = 0.4, at xi_j = j L / n_a. As in
the source the distance x - xi_j is not wrapped around the circle, so the first jet is half of one. An
episode begins on the attractor.

Sixth-order central differences of u_xx and u_xxxx; one-sided ones of fourth order on five points for
(u^2)_x, forwards where u < 0 and backwards elsewhere. The classical Runge-Kutta scheme, 250 steps
in an action.

References
----------
Werner, Peitz, "Numerical evidence for sample efficiency of model-based over model-free reinforcement
learning control of partial differential equations", ECC 2024 (github.com/stwerner97/pdecontrol).
Fornberg, "Generation of finite difference formulas on arbitrarily spaced grids", Math. Comp. 51, 1988.
"""

from __future__ import annotations

import math

import numpy as np

from pde_sim_node.arguments import positive, whole
from pde_sim_node.dynamics import Dynamics, arguments_of
from pdeloop.jit.cache import cached_njit
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Grid

_SIGMA = 0.4


class KuramotoSivashinskyFour(Dynamics):
    """A chaotic field whose mean square is to be small.

    Parameters
    ----------
    points
        Of the circle.
    length
        L.
    jets
        n_a.
    bound
        Largest magnitude of an action.
    action_cost
        R; Q is 1 / points. The source's reward has none.
    steps
        T, each of 0.25.
    substeps
        Time steps in an action.
    burn_in
        Actions of zero from a random field to the beginning of an episode.
    wrapped
        Whether the distance to a jet is that around the circle, which makes the first one whole.

    Raises
    ------
    ValueError
        A value is out of its range; the message names it.
    """

    sample_time, batched = 0.25, True
    grid: Grid

    def __init__(
        self,
        points: int = 64,
        length: float = 22.0,
        jets: int = 4,
        bound: float = 1.0,
        action_cost: float = 1e-3,
        steps: int = 400,
        substeps: int = 250,
        burn_in: int = 800,
        wrapped: bool = False,
    ) -> None:
        n, self.n_a = whole("points", points, 16), whole("jets", jets, 1)
        self.grid = Grid.interval(positive("length", length), n)
        self.action_high = positive("bound", bound)
        self.action_low = -self.action_high
        self.state_weight, self.action_weight = 1.0 / n, positive("action_cost", action_cost)
        self.horizon, self.substeps = whole("steps", steps, 1), whole("substeps", substeps, 1)
        self.burn_in = whole("burn_in", burn_in, 0)
        x = self.grid.axes[0].points
        far = np.abs(x[:, None] - length * np.arange(self.n_a) / self.n_a)
        far = np.minimum(far, length - far) if wrapped else far
        self._shapes = np.exp(-0.5 * (far / _SIGMA) ** 2) / math.sqrt(2 * math.pi * _SIGMA)
        self.supports = self._shapes

    def initial_state(self, rng: np.random.Generator) -> Array:
        """A field of the attractor: what becomes of a random one without control."""
        u = rng.uniform(-0.4, 0.4, (1, self.grid.size))
        for _ in range(self.burn_in):
            u = self.step(u, np.zeros((1, self.n_a)))
        start: Array = u[0]
        return start

    def mean_state(self) -> Array:
        """One field of the attractor, as the mean of them is no field of it."""
        return self.initial_state(np.random.default_rng(0))

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        return self.integrated(z, a)[0]

    def integrated(self, z: Array, a: Array) -> tuple[Array, Array]:
        """States after a step, and the mean squares (M,) of what its time steps begin with."""
        new, squares = z.copy(), np.zeros(len(z))
        for m in range(len(z)):
            forcing = np.zeros(self.grid.size)
            for j in range(self.n_a):  # in this order for every batch
                forcing += a[m, j] * self._shapes[:, j]
            dt, dx = self.sample_time / self.substeps, self.grid.axes[0].spacing
            squares[m] = advance(new[m], forcing, dt, dx, self.substeps)
        return new, squares

    def refined(self) -> KuramotoSivashinskyFour:
        """With half the internal time step."""
        return type(self)(**{**arguments_of(self), "substeps": 2 * self.substeps})


@cached_njit()
def advance(u: Array, forcing: Array, dt: float, dx: float, steps: int) -> float:
    """Advance a field (n,) in place; the mean of its square over points and beginnings of steps."""
    n = len(u)
    # With four points of either side beside the ends, as their neighbours on the circle.
    wide, square = np.empty(n + 8), np.empty(n + 8)
    rate, total, stage = np.empty(n), np.empty(n), np.empty(n)
    squares = 0.0
    for _ in range(steps):
        for i in range(n):
            squares += u[i] * u[i]
            stage[i] = u[i]
        for part in range(4):
            for i in range(n + 8):
                wide[i] = stage[(i - 4) % n]
                square[i] = 0.5 * wide[i] * wide[i]
            _rates(wide, square, forcing, dx, rate)
            weight = dt / 6.0 if part == 0 or part == 3 else dt / 3.0
            ahead = dt if part == 2 else 0.5 * dt
            for i in range(n):
                total[i] = (u[i] if part == 0 else total[i]) + weight * rate[i]
                stage[i] = u[i] + ahead * rate[i]
        for i in range(n):
            u[i] = total[i]
    return squares / (steps * n)


@cached_njit()
def _rates(wide: Array, square: Array, forcing: Array, dx: float, rate: Array) -> None:
    """u_t at n points, from u and u^2 / 2 at n + 8."""
    one, two, four = 1.0 / dx, 1.0 / dx**2, 1.0 / dx**4
    for j in range(len(rate)):
        i = j + 4
        s1 = wide[i - 1] + wide[i + 1]
        s2 = wide[i - 2] + wide[i + 2]
        s3 = wide[i - 3] + wide[i + 3]
        s4 = wide[i - 4] + wide[i + 4]
        second = two * (-49.0 / 18.0 * wide[i] + 1.5 * s1 - 0.15 * s2 + s3 / 90.0)
        fourth = four * (
            91.0 / 8.0 * wide[i]
            - 122.0 / 15.0 * s1
            + 169.0 / 60.0 * s2
            - 0.4 * s3
            + 7.0 / 240.0 * s4
        )
        forwards = -25.0 / 12.0 * square[i] + 4.0 * square[i + 1] - 3.0 * square[i + 2]
        forwards += 4.0 / 3.0 * square[i + 3] - 0.25 * square[i + 4]
        backwards = 25.0 / 12.0 * square[i] - 4.0 * square[i - 1] + 3.0 * square[i - 2]
        backwards -= 4.0 / 3.0 * square[i - 3] - 0.25 * square[i - 4]
        slope = one * (forwards if wide[i] < 0.0 else backwards)
        rate[j] = forcing[j] - second - fourth - slope
