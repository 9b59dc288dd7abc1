# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Fisher-KPP equation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Equation, Field, Spectrum, draw, parameter


@dataclass(frozen=True, kw_only=True)
class Fisher(Equation):
    """Fisher-KPP equation, u_t - D u_xx - rho u (1 - u) = a.

    Split as L = rho - D k^2, g(u) = u^2, m = -rho. Initial field A sin(4 pi x/L), target
    A_r cos(2 pi x/L). The state 1 is stable, 0 is not: above it fields go to 1 by fronts of speed
    2 sqrt(rho D) and more, below it they run away to minus infinity in the finite time
    log(1 + 1/|u|)/rho.

    Source: arXiv:2311.18736.
    """

    name: ClassVar[str] = "fisher"
    order: ClassVar[float] = 2.0

    length: float = parameter(10.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    diffusivity: float = parameter(1e-4, "diffusivity D", 0.0, 1e3, "length^2/time")
    reaction: float = parameter(0.1, "growth rate rho", 0.0, 1e3, "1/time")
    amplitude_min: float = parameter(0.9, "smallest amplitude A of the initial field", -1e2, 1e2)
    amplitude_max: float = parameter(1.1, "largest amplitude A of the initial field", -1e2, 1e2)
    target_amplitude: float = parameter(0.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return self.reaction - self.diffusivity * k**2

    def multiplier(self, k: Field) -> Spectrum:
        return np.full_like(k, -self.reaction)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        amplitude = draw(rng, self.amplitude_min, self.amplitude_max)
        return amplitude * np.sin(4 * np.pi * x / self.length)

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.cos(2 * np.pi * x / self.length)
