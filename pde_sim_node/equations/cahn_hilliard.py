# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Cahn-Hilliard equation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Equation, Field, Spectrum, draw, parameter


@dataclass(frozen=True, kw_only=True)
class CahnHilliard(Equation):
    """Cahn-Hilliard equation, u_t - D (u^3 - u)_xx + gamma D u_xxxx = a.

    Split as L = D (k^2 - gamma k^4), g(u) = u^3, m = -D k^2. Initial field A cos(pi y) -
    exp(-4 (pi y)^2) with y = x - L/2, target A_r cos(2 pi x/L). Phases -1 and +1 separate, with
    fronts of width ~ sqrt(gamma). The mean is conserved without forcing.

    Source: arXiv:2311.18736.
    """

    name: ClassVar[str] = "cahn-hilliard"
    order: ClassVar[float] = 4.0

    length: float = parameter(2.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    diffusivity: float = parameter(1.0, "diffusivity D", 0.0, 1e3, "length^2/time")
    surface_tension: float = parameter(0.02, "surface tension gamma", 0.0, 1e3, "length^2")
    amplitude_min: float = parameter(0.9, "smallest amplitude A of the initial field", -1e2, 1e2)
    amplitude_max: float = parameter(1.1, "largest amplitude A of the initial field", -1e2, 1e2)
    target_amplitude: float = parameter(0.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return self.diffusivity * (k**2 - self.surface_tension * k**4)

    def multiplier(self, k: Field) -> Spectrum:
        return -self.diffusivity * k**2

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        amplitude = draw(rng, self.amplitude_min, self.amplitude_max)
        y = np.pi * (x - self.length / 2)
        return amplitude * np.cos(y) - np.exp(-4 * y**2)

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.cos(2 * np.pi * x / self.length)
