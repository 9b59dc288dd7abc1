# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Swift-Hohenberg equation, u_t = r u - (1 + d_xx)^2 u - u^3 + a, which makes stripes."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations import Equation, Field, Spectrum, draw, parameter


@dataclass(frozen=True, kw_only=True)
class SwiftHohenberg(Equation):
    """Split as L = r - (1 - k^2)^2, g(u) = u^3, m = -1.

    For r > 0 stripes 2 sqrt(r/3) cos(x + phi) grow, with any phase phi. The initial field has stripes
    with a phase drawn around pi/2, the target has phase 0. ``length`` is a multiple of 2 pi.
    """

    name: ClassVar[str] = "swift-hohenberg"
    order: ClassVar[float] = 4.0

    drive: float = parameter(0.3, "drive r", -10.0, 10.0, "1/time")
    phase_min: float = parameter(1.4, "smallest phase of the initial stripes", -10.0, 10.0)
    phase_max: float = parameter(1.8, "largest phase of the initial stripes", -10.0, 10.0)

    def linear_operator(self, k: Field) -> Spectrum:
        return self.drive - (1 - k**2) ** 2

    def multiplier(self, k: Field) -> Spectrum:
        return np.full_like(k, -1.0)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u * u

    def stripes(self, x: Field, phase: float) -> Field:
        return 2 * np.sqrt(max(self.drive, 0.0) / 3) * np.cos(x + phase)

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        return self.stripes(x, draw(rng, self.phase_min, self.phase_max))

    def target(self, x: Field) -> Field:
        return self.stripes(x, 0.0)
