# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The convection-diffusion-reaction equation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Field, LinearEquation, Spectrum, draw, parameter, sech


@dataclass(frozen=True, kw_only=True)
class ConvectionDiffusionReaction(LinearEquation):
    """Convection-diffusion-reaction equation, u_t + c u_x - D u_xx - rho u = a.

    L = rho - i c k - D k^2. Initial field A sech((x - L/2)/b), target A_r cos(2 pi x/L).
    Wavenumbers below sqrt(rho/D) grow, k = 0 with rate rho.

    Source: arXiv:2311.18736.
    """

    name: ClassVar[str] = "convection-diffusion-reaction"
    order: ClassVar[float] = 2.0

    length: float = parameter(1.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    diffusivity: float = parameter(2e-3, "diffusivity D", 0.0, 1e3, "length^2/time")
    velocity: float = parameter(0.1, "velocity c of the convection", -1e3, 1e3, "length/time")
    reaction: float = parameter(0.1, "growth rate rho", -1e3, 1e3, "1/time")
    amplitude_min: float = parameter(0.9, "smallest amplitude A of the initial field", -1e2, 1e2)
    amplitude_max: float = parameter(1.1, "largest amplitude A of the initial field", -1e2, 1e2)
    spread_min: float = parameter(
        0.04, "smallest spread b of the initial field", 1e-6, 1e6, "length"
    )
    spread_max: float = parameter(
        0.06, "largest spread b of the initial field", 1e-6, 1e6, "length"
    )
    target_amplitude: float = parameter(0.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return self.reaction - 1j * self.velocity * k - self.diffusivity * k**2

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        amplitude = draw(rng, self.amplitude_min, self.amplitude_max)
        spread = draw(rng, self.spread_min, self.spread_max)
        return amplitude * sech((x - self.length / 2) / spread)

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.cos(2 * np.pi * x / self.length)
