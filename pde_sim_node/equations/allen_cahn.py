# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Allen-Cahn equation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Equation, Field, Spectrum, draw, parameter


@dataclass(frozen=True, kw_only=True)
class AllenCahn(Equation):
    """Allen-Cahn equation, u_t - nu^2 u_xx + V (u^3 - u) = a.

    Split as L = V - nu^2 k^2, g(u) = u^3, m = -V. Initial field c + (x - L/2)^2 cos(2 pi (x -
    L/2)/L), target -A_r cos(2 pi x/L). Unforced fields settle at the stable states -1 and +1 with
    fronts of width ~ nu/sqrt(V).

    Source: arXiv:2403.01005, problem 2.
    """

    name: ClassVar[str] = "allen-cahn"
    order: ClassVar[float] = 2.0

    length: float = parameter(2.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    diffusivity: float = parameter(5e-2, "diffusivity nu (enters squared)", 0.0, 1e3)
    potential: float = parameter(5.0, "strength V of the double-well potential", 0.0, 1e6, "1/time")
    offset_min: float = parameter(-0.1, "smallest offset c of the initial field", -1e2, 1e2)
    offset_max: float = parameter(0.1, "largest offset c of the initial field", -1e2, 1e2)
    target_amplitude: float = parameter(1.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return self.potential - self.diffusivity**2 * k**2

    def multiplier(self, k: Field) -> Spectrum:
        return np.full_like(k, -self.potential)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        offset = draw(rng, self.offset_min, self.offset_max)
        y = x - self.length / 2
        return offset + y**2 * np.cos(2 * np.pi * y / self.length)

    def target(self, x: Field) -> Field:
        return -self.target_amplitude * np.cos(2 * np.pi * x / self.length)
