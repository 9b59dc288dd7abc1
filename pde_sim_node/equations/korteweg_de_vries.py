# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Korteweg-de Vries equation."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Equation, Field, Spectrum, draw, parameter, sech


@dataclass(frozen=True, kw_only=True)
class KortewegDeVries(Equation):
    """Korteweg-de Vries equation, u_t + u_xxx - 6 u u_x = a.

    Split as L = i k^3, g(u) = u^2, m = 3 i k. The initial field -(alpha/2) sech^2(sqrt(alpha)/2
    (x - L/2)) is, on a long domain, the exact soliton moving with speed alpha to +x. Target
    A_r sin(2 pi x/L).

    Source: arXiv:2403.01005, problem 3.
    """

    name: ClassVar[str] = "kdv"
    order: ClassVar[float] = 3.0

    length: float = parameter(20.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    alpha_min: float = parameter(
        1.0, "smallest speed alpha of the soliton", 0.0, 1e2, "length/time"
    )
    alpha_max: float = parameter(3.0, "largest speed alpha of the soliton", 0.0, 1e2, "length/time")
    target_amplitude: float = parameter(1.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return 1j * k**3

    def multiplier(self, k: Field) -> Spectrum:
        return 3j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        alpha = draw(rng, self.alpha_min, self.alpha_max)
        return -alpha / 2 * sech(math.sqrt(alpha) / 2 * (x - self.length / 2)) ** 2

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.sin(2 * np.pi * x / self.length)
