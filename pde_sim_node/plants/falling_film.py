# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A film that falls down a wall, with jets: beacon's `shkadov-v0`.

    h_t = -q_x
    q_t = -6/5 (q^2/h)_x + 1/(5 delta) [h (h_xxx + 1) - q/h^2] - 5 sum_j u_j v_j(x)

with the height h and the flow rate q, both 1 in the flat film. It is convectively unstable: noise of h
at the inlet grows to solitary waves. Jet j blows at x_j = 150 + 10 j with v_j = 1 - ((x - x_j) / 2)^2
within 2; a positive action takes flow away. It is reached linearly from the last one within the first
two fifths of an action. The stage cost is dx / (50 n) sum (h - 1)^2 over the 10 units behind each jet,
which is the source's reward with the other sign, and action_cost |u|^2.

Backward differences of fluxes that are limited by minmod, third derivatives from five points around and
ahead; Adams-Bashforth of second order, begun by an Euler step in each action. Inlet: q = 1, h = 1 plus
uniform noise, anew in each time step, drawn from a generator whose seed is a checksum of the state;
outlet: zero gradient. First order in space.

References
----------
Viquerat, Hachem, "Beacon, a lightweight deep reinforcement learning benchmark library for flow
control", 2023. Belus et al., "Exploiting locality and translational invariance to design effective deep
reinforcement learning control of the 1-dimensional unstable falling liquid film", AIP Advances 9, 2019.
"""

from __future__ import annotations

import zlib

import numpy as np

from pde_sim_node.arguments import positive, whole
from pde_sim_node.dynamics import Dynamics, arguments_of
from pdeloop.jit.cache import cached_njit
from pdeloop.messages.arrays import Array

FIRST, BETWEEN = 150.0, 10.0
"""Place of the first jet, and the distance from each to the next."""
_RAMP = 0.4
"""Share of an action in which it is reached."""


class FallingFilm(Dynamics):
    """z = (h, q, u): heights and flow rates at the points i dx, and the last actions.

    Parameters
    ----------
    jets
        n.
    delta
        Reduced Reynolds number.
    noise
        Largest disturbance of h at the inlet.
    action_cost
        R.
    steps
        T, each of 0.05.
    spacing
        dx.
    substeps
        Time steps in an action.
    developed
        Time without jets from the flat film, with which all episodes begin; some have up to 400 actions
        of zero more.

    Raises
    ------
    ValueError
        A value is out of its range; the message names it.
    """

    sample_time, batched = 0.05, True
    action_low, action_high = -1.0, 1.0
    divergence_bound = 25.0
    target = 1.0

    def __init__(
        self,
        jets: int = 5,
        delta: float = 0.1,
        noise: float = 5e-4,
        action_cost: float = 1e-4,
        steps: int = 400,
        spacing: float = 0.2,
        substeps: int = 50,
        developed: float = 200.0,
    ) -> None:
        self.n_a, self.horizon = whole("jets", jets, 1), whole("steps", steps, 1)
        self.delta, self.dx = positive("delta", delta), positive("spacing", spacing)
        self.noise = noise if noise == 0 else positive("noise", noise)
        self.substeps, self.developed = whole("substeps", substeps, 1), developed
        self.action_weight = positive("action_cost", action_cost)
        n = self.points = round((FIRST + BETWEEN * (jets + 2)) / self.dx)
        self.n_z = 2 * n + self.n_a
        x = self.dx * np.arange(n)
        far = (x[:, None] - FIRST - BETWEEN * np.arange(self.n_a)) / 2.0
        self.shapes = np.where(np.abs(far) <= 1.0, 1.0 - far**2, 0.0)
        behind = round(BETWEEN / self.dx)
        self.first = [round((FIRST + BETWEEN * j) / self.dx) for j in range(self.n_a)]
        self.output = np.zeros((behind * self.n_a, self.n_z))
        places = np.concatenate([first + np.arange(behind) for first in self.first])
        self.output[np.arange(len(places)), places] = 1.0
        self.state_weight = self.dx / len(places)
        self.supports = np.zeros((self.n_z, self.n_a))
        self.supports[n : 2 * n] = self.shapes
        self._start: Array | None = None

    def mean_state(self) -> Array:
        """The film whose waves have developed without jets."""
        if self._start is None:
            z = np.ones((1, self.n_z))
            z[:, 2 * self.points :] = 0.0
            for _ in range(round(self.developed / self.sample_time)):
                z = self.step(z, np.zeros((1, self.n_a)))
            self._start = z[0]
        return self._start.copy()

    def initial_state(self, rng: np.random.Generator) -> Array:
        """The developed film after 0 to 400 more actions of zero."""
        z = self.mean_state()[None]
        z[0, 0] += 1e-12 * rng.standard_normal()  # so that its noise is another
        for _ in range(rng.integers(0, 401)):
            z = self.step(z, np.zeros((1, self.n_a)))
        start: Array = z[0]
        return start

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        new, n = z.copy(), self.points
        for m in range(len(z)):
            rng = np.random.default_rng(zlib.crc32(z[m].tobytes()))
            inlet = 1.0 + self.noise * rng.uniform(-1.0, 1.0, self.substeps)
            fields, last = new[m, : 2 * n].reshape(2, n), z[m, 2 * n :]
            dt = self.sample_time / self.substeps
            fall(fields, self.shapes, last, a[m], inlet, self.dx, dt, self.delta)
            new[m, 2 * n :] = a[m]
        return new

    def refined(self) -> FallingFilm:
        """With half the internal time step."""
        return type(self)(**{**arguments_of(self), "substeps": 2 * self.substeps})


@cached_njit()
def fall(
    fields: Array,
    shapes: Array,
    last: Array,
    action: Array,
    inlet: Array,
    dx: float,
    dt: float,
    delta: float,
) -> None:
    """Advance h and q (2, n), in place, by as many time steps as inlet has heights."""
    h, q = fields[0], fields[1]
    n, steps = len(h), len(inlet)
    flux, moved = np.zeros(n), np.zeros(n)
    h_rate, q_rate, h_old, q_old = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    blown = np.zeros(n)
    third, pull = 0.5 / dx**3, 1.0 / (5.0 * delta)
    begin = n
    for i in range(n):
        if shapes[i].max() > 0.0:
            begin = i
            break
    for s in range(steps):
        h[0], q[0] = inlet[s], 1.0
        h[n - 1], q[n - 1] = h[n - 2], q[n - 2]
        share = min(1.0, s / (_RAMP * steps))
        for i in range(begin, n):
            blown[i] = 0.0
            for j in range(len(action)):
                blown[i] += shapes[i, j] * (last[j] + share * (action[j] - last[j]))
        for i in range(n):
            moved[i] = 1.2 * q[i] * q[i] / h[i]
        _limited(q, flux)
        for i in range(1, n - 1):
            h_rate[i] = -(flux[i] - flux[i - 1]) / dx
        _limited(moved, flux)
        for i in range(1, n - 1):
            if i < n - 3:
                hxxx = third * (
                    -h[i + 3] + 6.0 * h[i + 2] - 12.0 * h[i + 1] + 10.0 * h[i] - 3.0 * h[i - 1]
                )
            else:
                hxxx = 2.0 * third * (h[n - 1] - 3.0 * h[n - 2] + 3.0 * h[n - 3] - h[n - 4])
            gravity = h[i] * (hxxx + 1.0) - q[i] / (h[i] * h[i])
            q_rate[i] = pull * gravity - (flux[i] - flux[i - 1]) / dx - 5.0 * blown[i]
        new, old = (1.0, 0.0) if s == 0 else (1.5, 0.5)
        for i in range(1, n - 1):
            h[i] += dt * (new * h_rate[i] - old * h_old[i])
            q[i] += dt * (new * q_rate[i] - old * q_old[i])
        h_old, h_rate = h_rate, h_old
        q_old, q_rate = q_rate, q_old
    h[n - 1], q[n - 1] = h[n - 2], q[n - 2]


@cached_njit()
def _limited(f: Array, flux: Array) -> None:
    """Fluxes at the right of each point but the last, limited by minmod."""
    flux[0] = f[0]
    for i in range(1, len(f) - 1):
        ahead = f[i + 1] - f[i]
        ratio = (f[i] - f[i - 1]) / (ahead + 1e-8)
        flux[i] = f[i] + 0.5 * max(0.0, min(1.0, ratio)) * ahead
