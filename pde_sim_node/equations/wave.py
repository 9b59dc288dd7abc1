# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The wave equation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Field, LinearEquation, Spectrum, draw, parameter, sech


@dataclass(frozen=True, kw_only=True)
class Wave(LinearEquation):
    """Wave equation, u_tt - c^2 u_xx = a, as (u, v)_t = (v, c^2 u_xx + a).

    L = [[0, 1], [-c^2 k^2, 0]]. Initial field A sech((x - L/2)/b) at rest, target A_r cos(2 pi x/L)
    at rest. Without forcing the energy c^2 u_x^2 + v^2 is conserved; the mean of u drifts.

    Source: arXiv:2311.18736.
    """

    name: ClassVar[str] = "wave"
    order: ClassVar[float] = 2.0
    components: ClassVar[tuple[str, ...]] = ("u", "u_t")
    actuated: ClassVar[int] = 1

    length: float = parameter(1.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    speed: float = parameter(0.1, "speed c of the waves", 0.0, 1e3, "length/time")
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
        operator = np.zeros((len(k), 2, 2))
        operator[:, 0, 1] = 1
        operator[:, 1, 0] = -(self.speed**2) * k**2
        return operator

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        amplitude = draw(rng, self.amplitude_min, self.amplitude_max)
        spread = draw(rng, self.spread_min, self.spread_max)
        bump = amplitude * sech((x - self.length / 2) / spread)
        return np.stack([bump, np.zeros_like(x)])

    def target(self, x: Field) -> Field:
        shape = self.target_amplitude * np.cos(2 * np.pi * x / self.length)
        return np.stack([shape, np.zeros_like(x)])
