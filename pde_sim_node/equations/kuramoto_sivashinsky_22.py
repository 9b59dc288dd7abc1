# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Kuramoto-Sivashinsky equation with Gaussian actuators and an equilibrium as target."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Equation, Field, Spectrum, draw, parameter

_WAVES, _STEPS = 40, 50


@dataclass(frozen=True, kw_only=True)
class KuramotoSivashinsky22(Equation):
    """Kuramoto-Sivashinsky equation, u_t + u u_x + u_xx + u_xxxx = a, from chaos to an equilibrium.

    The actuators are Gaussians exp(-d^2 / (2 sigma^2)) at j L/n_a, sigma = width L. Initial field: sum
    of A_j sin(2 pi j x/L + phi_j), j = 1, 2, 3, from which the chaotic attractor is soon reached.
    Target: one of the unstable equilibria E1, E2, E3, in the place where u(-x) = -u(x).

    Sources: Bucci, Semeraro, Allauzen, Wisniewski, Cordier, Mathelin, "Control of chaotic systems by
    deep reinforcement learning", Proc. R. Soc. A 475, 2019 (the benchmark). Cvitanovic, Davidchack,
    Siminos, "On the state space geometry of the Kuramoto-Sivashinsky flow in a periodic domain", SIAM
    J. Appl. Dyn. Syst. 9, 2010 (the equilibria).
    """

    name: ClassVar[str] = "kuramoto-sivashinsky-22"
    order: ClassVar[float] = 4.0

    length: float = parameter(22.0, "length L of the periodic domain", 1.0, 1e3, "length")
    amplitude_min: float = parameter(0.9, "smallest amplitude A of the initial waves", -1e2, 1e2)
    amplitude_max: float = parameter(1.1, "largest amplitude A of the initial waves", -1e2, 1e2)
    equilibrium: float = parameter(2.0, "which of E1, E2 and E3 is the target: 1, 2 or 3", 1.0, 3.0)

    def linear_operator(self, k: Field) -> Spectrum:
        return k**2 - k**4

    def multiplier(self, k: Field) -> Spectrum:
        return -0.5j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        phase = 2 * np.pi * x / self.length
        field = np.zeros_like(x)
        for wave in (1, 2, 3):
            amplitude = draw(rng, self.amplitude_min, self.amplitude_max)
            field += amplitude * np.sin(wave * phase + draw(rng, 0.0, 2 * np.pi))
        return field

    def supports(self, x: Field, n_a: int, width: float) -> Field:
        centres = self.length * np.arange(n_a) / n_a
        distance = np.abs(x[:, None] - centres)
        distance = np.minimum(distance, self.length - distance)
        shapes: Field = np.exp(-0.5 * (distance / (width * self.length)) ** 2)
        return shapes

    def target(self, x: Field) -> Field:
        """Newton's method for u = sum_j b_j sin(2 pi j x/L), from 2 sin(2 pi q x/L) for Eq."""
        j = np.arange(1, _WAVES + 1)
        k = 2 * np.pi * j / self.length
        points = self.length * np.arange(4 * _WAVES) / (4 * _WAVES)
        sines, cosines = np.sin(np.outer(points, k)), np.cos(np.outer(points, k))
        to_sines = 2 / len(points) * sines.T
        b = np.where(j == round(self.equilibrium), 2.0, 0.0)
        for _ in range(_STEPS):
            u, slope = sines @ b, cosines @ (k * b)
            rate = (k**2 - k**4) * b - to_sines @ (u * slope)
            jacobian = np.diag(k**2 - k**4) - to_sines @ (
                slope[:, None] * sines + u[:, None] * cosines * k
            )
            b = b - np.linalg.solve(jacobian, rate)
        field: Field = np.sin(np.outer(x, k)) @ b
        return field
