# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The viscous Burgers equation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Equation, Field, Spectrum, draw, parameter, sech


@dataclass(frozen=True, kw_only=True)
class Burgers(Equation):
    """Viscous Burgers equation, u_t + u u_x - nu u_xx = a.

    Split as L = -nu k^2, g(u) = u^2, m = -i k/2. Initial field A sech((x - L/2)/b), target
    A_r cos(2 pi x/L).
    Shocks form at time ~ 1/max|u_x| and have width ~ nu; below about 3 grid points per width the
    field oscillates.

    Source: arXiv:2403.01005, problem 1.
    """

    name: ClassVar[str] = "burgers"
    order: ClassVar[float] = 2.0

    length: float = parameter(1.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    viscosity: float = parameter(1e-4, "viscosity nu", 0.0, 1e3, "length^2/time")
    amplitude_min: float = parameter(0.9, "smallest amplitude A of the initial field", -1e2, 1e2)
    amplitude_max: float = parameter(1.1, "largest amplitude A of the initial field", -1e2, 1e2)
    spread_min: float = parameter(
        0.04, "smallest spread b of the initial field", 1e-6, 1e6, "length"
    )
    spread_max: float = parameter(
        0.06, "largest spread b of the initial field", 1e-6, 1e6, "length"
    )
    target_amplitude: float = parameter(0.1, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return -self.viscosity * k**2

    def multiplier(self, k: Field) -> Spectrum:
        return -0.5j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        amplitude = draw(rng, self.amplitude_min, self.amplitude_max)
        spread = draw(rng, self.spread_min, self.spread_max)
        return amplitude * sech((x - self.length / 2) / spread)

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.cos(2 * np.pi * x / self.length)
