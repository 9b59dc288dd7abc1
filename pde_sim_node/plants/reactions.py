# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A reacting plate, Gray-Scott, the Brusselator, FitzHugh-Nagumo and complex Ginzburg-Landau.

Each says its equation, where it rests and good values; the numerics are those of
`pde_sim_node.plants.reaction_diffusion`.

References
----------
Pearson, "Complex patterns in a simple system", Science 261, 1993 (Gray-Scott). Cross, Hohenberg,
"Pattern formation outside of equilibrium", Rev. Mod. Phys. 65, 1993 (Brusselator). Murray,
"Mathematical Biology", 2002 (FitzHugh-Nagumo). Aranson, Kramer, "The world of the complex
Ginzburg-Landau equation", Rev. Mod. Phys. 74, 2002.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pde_sim_node.arguments import Coefficient, positive, values_at
from pde_sim_node.plants.reaction_diffusion import OnInterval, ReactionDiffusion
from pde_sim_node.plants.variable_diffusion import VariableDiffusion
from pdeloop.messages.arrays import Array


class Plate(ReactionDiffusion):
    """u_t = div(D grad u) + r u - b u^3 on a rectangle: heat for r = b = 0.

    With r > 0 rest is unstable: without flux through the walls for all waves with D |k|^2 < r. D, r and
    b are numbers, functions of x and y, or values at the points, row by row. Where D is not a number,
    diffusion is solved as in `pde_sim_node.plants.variable_diffusion` in place of exact waves.
    """

    horizon, sample_time = 50, 0.1
    state_weight, action_weight = 0.01, 0.1

    def __init__(
        self,
        nx: int = 32,
        ny: int = 24,
        width: float = 1.5,
        height: float = 1.0,
        diffusivity: Coefficient = 0.05,
        growth: Coefficient = 1.0,
        saturation: Coefficient = 1.0,
        walls: str = "neumann",
        across: int = 2,
        up: int = 2,
        spread: float = 0.5,
        step_time: float = 0.02,
    ) -> None:
        self._D = diffusivity
        if isinstance(diffusivity, int | float):
            self._D = positive("diffusivity", float(diffusivity))
        super().__init__(
            points=(ny, nx),
            lengths=(height, width),
            walls=walls,
            actuators=(up, across),
            spread=spread,
            step_time=step_time,
        )
        y, x = np.meshgrid(*(axis.points for axis in self.grid.axes), indexing="ij")
        self._r, self._b = (
            given if isinstance(given, int | float) else values_at(name, given, x, y)
            for name, given in (("growth", growth), ("saturation", saturation))
        )

    @property
    def rest(self) -> Sequence[float]:
        """0."""
        return (0.0,)

    @property
    def diffusion(self) -> Array:
        """D; its mean where it depends on the place."""
        return np.array([[self._D if self._variable is None else self._variable.at_points.mean()]])

    def _propagate(self) -> Array:
        self._variable: VariableDiffusion | None = None
        if isinstance(self._D, float):
            return super()._propagate()
        self._variable = VariableDiffusion(self.grid, self.walls, self._D, self._dt)
        return np.empty(0)

    def _diffused(self, w: Array) -> Array:
        return super()._diffused(w) if self._variable is None else self._variable.step(w)

    def reaction(self, w: Array) -> Array:
        """r u - b u^3."""
        return self._r * w - self._b * w**3


class TwoComponents(OnInterval):
    """Two components u and v on an interval, each with a diffusivity of its own."""

    components = ("u", "v")

    def __init__(self, diffusivities: tuple[float, float], *interval: Any) -> None:
        named = zip(("diffusivity_u", "diffusivity_v"), diffusivities, strict=True)
        self._D = [positive(name, value) for name, value in named]
        super().__init__(*interval)

    @property
    def diffusion(self) -> Array:
        """diag(D_u, D_v)."""
        return np.diag(self._D)


class GrayScott(TwoComponents):
    """u_t = D_u u_xx - u v^2 + F (1 - u) + a,  v_t = D_v v_xx + u v^2 - (F + k) v.

    Rest is the state (u, v) of the larger v that does not change without diffusion.
    """

    horizon, sample_time = 100, 1.0
    state_weight, action_weight = 1.0, 100.0

    def __init__(
        self,
        points: int = 64,
        length: float = 0.5,
        feed: float = 0.04,
        kill: float = 0.055,
        diffusivity_u: float = 2e-5,
        diffusivity_v: float = 1e-5,
        walls: str = "periodic",
        actuators: int = 4,
        spread: float = 0.05,
        step_time: float = 0.5,
    ) -> None:
        self._F, self._k = positive("feed", feed), positive("kill", kill)
        if 4.0 * (feed + kill) ** 2 > feed:
            raise ValueError(
                f"feed {feed:g} and kill {kill:g} allow no state but u = 1, v = 0: 4 (feed + kill)^2 "
                "must be at most feed"
            )
        super().__init__(
            (diffusivity_u, diffusivity_v), points, length, walls, actuators, spread, step_time
        )

    @property
    def rest(self) -> Sequence[float]:
        """u v = F + k and F (1 - u) = (F + k) v."""
        lost = self._F + self._k
        u = 0.5 * (1.0 - float(np.sqrt(1.0 - 4.0 * lost**2 / self._F)))
        return (u, lost / u)

    def reaction(self, w: Array) -> Array:
        """See the class."""
        u, v = w[:, 0], w[:, 1]
        made = u * v**2
        return np.stack([self._F * (1.0 - u) - made, made - (self._F + self._k) * v], axis=1)


class Brusselator(TwoComponents):
    """u_t = D_u u_xx + A - (B + 1) u + u^2 v + a,  v_t = D_v v_xx + B u - u^2 v; rest is (A, B/A).

    It oscillates for B > 1 + A^2, and has patterns for B > (1 + A sqrt(D_u/D_v))^2.
    """

    horizon, sample_time = 100, 0.1
    state_weight, action_weight = 0.1, 0.1

    def __init__(
        self,
        points: int = 64,
        length: float = 20.0,
        A: float = 1.0,
        B: float = 2.2,
        diffusivity_u: float = 1.0,
        diffusivity_v: float = 4.0,
        walls: str = "periodic",
        actuators: int = 6,
        spread: float = 0.1,
        step_time: float = 0.05,
    ) -> None:
        self._A, self._B = positive("A", A), positive("B", B)
        super().__init__(
            (diffusivity_u, diffusivity_v), points, length, walls, actuators, spread, step_time
        )

    @property
    def rest(self) -> Sequence[float]:
        """(A, B/A)."""
        return (self._A, self._B / self._A)

    def reaction(self, w: Array) -> Array:
        """See the class."""
        u, v = w[:, 0], w[:, 1]
        made = u**2 * v
        return np.stack([self._A - (self._B + 1.0) * u + made, self._B * u - made], axis=1)


class FitzHughNagumo(TwoComponents):
    """u_t = D_u u_xx + u - u^3 - v + a,  v_t = D_v v_xx + eps (u - g v).

    Rest is 0; it is unstable for g eps < 1.
    """

    horizon, sample_time = 100, 0.2
    state_weight, action_weight = 0.1, 0.1

    def __init__(
        self,
        points: int = 64,
        length: float = 20.0,
        epsilon: float = 0.1,
        recovery: float = 0.5,
        diffusivity_u: float = 1.0,
        diffusivity_v: float = 0.1,
        walls: str = "neumann",
        actuators: int = 6,
        spread: float = 0.3,
        step_time: float = 0.05,
    ) -> None:
        self._eps, self._g = positive("epsilon", epsilon), positive("recovery", recovery)
        super().__init__(
            (diffusivity_u, diffusivity_v), points, length, walls, actuators, spread, step_time
        )

    @property
    def rest(self) -> Sequence[float]:
        """0."""
        return (0.0, 0.0)

    def reaction(self, w: Array) -> Array:
        """See the class."""
        u, v = w[:, 0], w[:, 1]
        return np.stack([u - u**3 - v, self._eps * (u - self._g * v)], axis=1)


class ComplexGinzburgLandau(OnInterval):
    """A_t = A + (1 + i alpha) A_xx - (1 + i beta) |A|^2 A + a; the state is Re A, Im A, rest is 0.

    Actuators force the real part, and as many the imaginary one, without which not all waves of one
    length could be reached.
    Waves with |k| < 1 grow at rest. For alpha beta < -1 no wave is stable, and A is chaotic.
    """

    components = ("Re A", "Im A")
    forced = (0, 1)
    horizon, sample_time = 100, 0.1
    state_weight, action_weight = 0.1, 0.1

    def __init__(
        self,
        points: int = 64,
        length: float = 20.0,
        alpha: float = 2.0,
        beta: float = -1.0,
        walls: str = "periodic",
        actuators: int = 8,
        spread: float = 0.3,
        step_time: float = 0.02,
    ) -> None:
        self._alpha, self._beta = alpha, beta
        super().__init__(points, length, walls, actuators, spread, step_time)

    @property
    def rest(self) -> Sequence[float]:
        """0."""
        return (0.0, 0.0)

    @property
    def diffusion(self) -> Array:
        """1 + i alpha as a matrix of real and imaginary part."""
        return np.array([[1.0, -self._alpha], [self._alpha, 1.0]])

    def reaction(self, w: Array) -> Array:
        """See the class."""
        x, y = w[:, 0], w[:, 1]
        size = x**2 + y**2
        return np.stack([x - size * (x - self._beta * y), y - size * (y + self._beta * x)], axis=1)
