# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Kuramoto-Sivashinsky equation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Equation, Field, Spectrum, draw, parameter


@dataclass(frozen=True, kw_only=True)
class KuramotoSivashinsky(Equation):
    """Kuramoto-Sivashinsky equation, u_t + u u_x + u_xx + u_xxxx = a.

    Split as L = k^2 - k^4, g(u) = u^2, m = -i k/2. Initial field A cos(2 pi x/L) sin(12 pi x/L),
    target A_r cos(2 pi x/L). Wavenumbers below 1 grow, the fastest, k = 1/sqrt(2), with rate 1/4;
    for L above about 20 the field is chaotic. The mean is conserved without forcing.

    Source: arXiv:2311.18736.
    """

    name: ClassVar[str] = "kuramoto-sivashinsky"
    order: ClassVar[float] = 4.0

    length: float = parameter(32 * np.pi, "length L of the periodic domain", 1e-3, 1e6, "length")
    amplitude_min: float = parameter(0.9, "smallest amplitude A of the initial field", -1e2, 1e2)
    amplitude_max: float = parameter(1.1, "largest amplitude A of the initial field", -1e2, 1e2)
    target_amplitude: float = parameter(0.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return k**2 - k**4

    def multiplier(self, k: Field) -> Spectrum:
        return -0.5j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        amplitude = draw(rng, self.amplitude_min, self.amplitude_max)
        phase = 2 * np.pi * x / self.length
        return amplitude * np.cos(phase) * np.sin(6 * phase)

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.cos(2 * np.pi * x / self.length)
