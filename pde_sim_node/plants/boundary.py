# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear PDEs on [0, L] that are controlled through their right end, u(L, t) = a.

Transport with recirculation, u_t = u_x + beta(x) u(0, t), and reaction-diffusion, u_t = u_xx + beta(x)
u with u(0, t) = 0: unstable, with known answers by backstepping. The tasks of PDEControlGym, on its
grids, with its schemes and time steps: upwind or central differences and explicit Euler, each step from
the field and the end before it; their product over a sampling time is one matrix. First order in space
for transport, second for reaction-diffusion. Actions are bounded as those of its agents.

References
----------
Krstic, Smyshlyaev, "Boundary Control of PDEs", SIAM 2008, chapters 4 and 9. Bhan, Bian, Krstic, Shi,
"PDE Control Gym", L4DC 2024.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from pde_sim_node.arguments import Coefficient, internal_steps, positive, values_at, whole
from pde_sim_node.dynamics import Dynamics
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Grid


class BoundaryControlled(Dynamics):
    """z = u at the points i L / n, i = 0 .. n, the last of which is what was given there.

    Parameters
    ----------
    intervals
        n.
    strength
        Factor of beta.
    rate
        g of beta = strength cos(g arccos(x / L)).
    beta
        Another beta: a function of x, or its values at the points.
    action_cost
        R; Q is 1 / n.
    step_time
        Internal time step, of which sample_time is a whole multiple.
    length
        L.
    bound
        Largest magnitude of an action.

    Raises
    ------
    ValueError
        A value is out of its range; the message names it.
    """

    n_a = 1
    divergence_bound = 1e6
    grid: Grid
    _given_ends: tuple[int, ...] = (-1,)

    def __init__(
        self,
        intervals: int,
        strength: float,
        rate: float,
        action_cost: float,
        step_time: float,
        beta: Coefficient | None,
        length: float,
        bound: float,
    ) -> None:
        n = whole("intervals", intervals, 4)
        self.grid = Grid.interval(positive("length", length), n + 1, periodic=False)
        self.x = self.grid.axes[0].points
        self.per_interval, self.strength, self.rate = n / length, strength, rate
        known = strength * np.cos(rate * np.arccos(np.linspace(0.0, 1.0, n + 1)))
        self.beta = known if beta is None else values_at("beta", beta, self.x)
        self.state_weight, self.action_weight = 1.0 / n, positive("action_cost", action_cost)
        self.action_high = positive("bound", bound)
        self.action_low = -self.action_high
        self.steps = internal_steps(self.sample_time, positive("step_time", step_time))
        self._one = np.eye(n + 1)
        self._one[:-1] += step_time * self.rates()
        self.A, self.B = self.advance(self.steps)
        self.supports = np.zeros((n + 1, 1))
        self.supports[-1] = 1.0

    @abstractmethod
    def rates(self) -> Array:
        """du/dt at all points but the last, as a matrix (n, n + 1)."""

    def advance(self, steps: int) -> tuple[Array, Array]:
        """A (n + 1, n + 1) and B (n + 1, 1) over the first internal steps of an action."""
        # The held end is a state that changes at the end of the first of them alone.
        first, later = self._one.copy(), np.linalg.matrix_power(self._one, steps - 1)
        first[list(self._given_ends)] = 0.0
        return later @ first, later[:, -1:].copy()

    def initial_state(self, rng: np.random.Generator) -> Array:
        """A constant from 1 to 10."""
        return np.full(self.grid.size, rng.uniform(1.0, 10.0))

    def mean_state(self) -> Array:
        """5.5."""
        return np.full(self.grid.size, 5.5)

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        after: Array = self.A @ z + self.B @ a
        return after

    def pull_back(self, z: Array, a: Array, y: Array) -> tuple[Array, Array]:
        """See `Dynamics.pull_back`."""
        return self.A.T @ y, self.B.T @ y


class Transport(BoundaryControlled):
    """u_t = u_x + beta(x) u(0, t), u(L, t) = a, over a time of 5 with actions held for 0.1.

    The source's 100 points with a spacing of 0.01 are 99 intervals of a length of 0.99.
    """

    sample_time, horizon = 0.1, 50

    def __init__(
        self,
        intervals: int = 100,
        strength: float = 5.0,
        rate: float = 7.35,
        action_cost: float = 0.1,
        step_time: float = 1e-4,
        beta: Coefficient | None = None,
        length: float = 1.0,
        bound: float = 20.0,
    ) -> None:
        super().__init__(intervals, strength, rate, action_cost, step_time, beta, length, bound)

    def rates(self) -> Array:
        """Upwind differences."""
        n = len(self.x) - 1
        found = self.per_interval * (np.eye(n, n + 1, 1) - np.eye(n, n + 1))
        found[:, 0] += self.beta[:-1]
        return found


class ReactionDiffusionBoundary(BoundaryControlled):
    """u_t = u_xx + beta(x) u, u(0, t) = 0, u(L, t) = a, over a time of 1 with actions held for 1e-3."""

    sample_time, horizon = 1e-3, 1000
    _given_ends = (0, -1)

    def __init__(
        self,
        intervals: int = 200,
        strength: float = 50.0,
        rate: float = 8.0,
        action_cost: float = 0.1,
        step_time: float = 1e-5,
        beta: Coefficient | None = None,
        length: float = 1.0,
        bound: float = 20.0,
    ) -> None:
        super().__init__(intervals, strength, rate, action_cost, step_time, beta, length, bound)

    def rates(self) -> Array:
        """Central differences; the first point is held at 0."""
        n = len(self.x) - 1
        found = self.per_interval**2 * (
            np.eye(n, n + 1, 1) - 2.0 * np.eye(n, n + 1) + np.eye(n, n + 1, -1)
        )
        found += np.diag(self.beta)[:-1]
        found[0] = 0.0
        return found
