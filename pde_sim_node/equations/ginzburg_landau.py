# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The real Ginzburg-Landau equation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Equation, Field, Spectrum, draw, parameter


@dataclass(frozen=True, kw_only=True)
class GinzburgLandau(Equation):
    """Ginzburg-Landau equation with real coefficients and a real field, u_t - u_xx - u + |u|^2 u = a.

    Split as L = 1 - k^2, g(u) = u^3, m = -1. Initial field A (tanh(y + b/2) - tanh(y - b/2)) with
    y = x - L/2, target A_r cos(2 pi x/L). The states -1 and +1 are stable and invade the unstable
    0 with speed 2.

    Source: arXiv:2311.18736.
    """

    name: ClassVar[str] = "ginzburg-landau"
    order: ClassVar[float] = 2.0

    length: float = parameter(100.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    amplitude_min: float = parameter(0.075, "smallest amplitude A of the initial field", -1e2, 1e2)
    amplitude_max: float = parameter(0.125, "largest amplitude A of the initial field", -1e2, 1e2)
    width_min: float = parameter(15.0, "smallest width b of the initial field", 1e-6, 1e6, "length")
    width_max: float = parameter(25.0, "largest width b of the initial field", 1e-6, 1e6, "length")
    target_amplitude: float = parameter(0.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return 1 - k**2

    def multiplier(self, k: Field) -> Spectrum:
        return np.full_like(k, -1.0)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        amplitude = draw(rng, self.amplitude_min, self.amplitude_max)
        width = draw(rng, self.width_min, self.width_max)
        y = x - self.length / 2
        return amplitude * (np.tanh(y + width / 2) - np.tanh(y - width / 2))

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.cos(2 * np.pi * x / self.length)
