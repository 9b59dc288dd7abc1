# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Schrödinger equation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Field, LinearEquation, Spectrum, draw, parameter, sech


@dataclass(frozen=True, kw_only=True)
class Schrodinger(LinearEquation):
    """Schrödinger equation, i hbar psi_t = -hbar^2/(2 m) psi_xx + V psi, in psi = u + i v.

    With w(k) = hbar k^2/(2 m) + V/hbar it is (u, v)_t = (w v, -w u + a), so L = [[0, w], [-w, 0]].
    Initial field u = A sech((x - L/2)/b), v = 0; target u = A_r cos(2 pi x/L), v = 0. Without
    forcing the norm of psi is conserved in each wavenumber. The forcing is that of controlgym: an
    additive input to v, not a potential that a laboratory could switch on.

    Source: arXiv:2311.18736.
    """

    name: ClassVar[str] = "schrodinger"
    order: ClassVar[float] = 2.0
    components: ClassVar[tuple[str, ...]] = ("Re ψ", "Im ψ")
    actuated: ClassVar[int] = 1

    length: float = parameter(1.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    planck: float = parameter(1.0, "Planck's constant hbar", 1e-6, 1e3)
    mass: float = parameter(1.0, "mass m of the particle", 1e-6, 1e6)
    potential: float = parameter(0.0, "constant potential V", -1e6, 1e6)
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
        frequency = self.planck * k**2 / (2 * self.mass) + self.potential / self.planck
        operator = np.zeros((len(k), 2, 2))
        operator[:, 0, 1], operator[:, 1, 0] = frequency, -frequency
        return operator

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        amplitude = draw(rng, self.amplitude_min, self.amplitude_max)
        spread = draw(rng, self.spread_min, self.spread_max)
        bump = amplitude * sech((x - self.length / 2) / spread)
        return np.stack([bump, np.zeros_like(x)])

    def target(self, x: Field) -> Field:
        shape = self.target_amplitude * np.cos(2 * np.pi * x / self.length)
        return np.stack([shape, np.zeros_like(x)])
