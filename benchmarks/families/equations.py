# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""PDEs that the project does not ship, all from random Fourier modes."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations import Field, RandomModes, Spectrum, parameter
from pde_sim_node.equations.random_modes import AllenCahnModes
from pde_sim_node.supports import indicator_supports


@dataclass(frozen=True, kw_only=True)
class BenjaminOno(RandomModes):
    """Benjamin-Ono, u_t + u u_x + H u_xx = a, with the Hilbert transform H: L(k) = i k |k|."""

    name: ClassVar[str] = "benjamin-ono"
    order: ClassVar[float] = 2.0

    length: float = parameter(20.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    target_amplitude: float = parameter(0.5, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return 1j * k * np.abs(k)

    def multiplier(self, k: Field) -> Spectrum:
        return -0.5j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.sin(2 * np.pi * x / self.length)


@dataclass(frozen=True, kw_only=True)
class Kawahara(RandomModes):
    """Kawahara, u_t + u u_x + u_xxx - u_xxxxx = a: a linear part of fifth order."""

    name: ClassVar[str] = "kawahara"
    order: ClassVar[float] = 5.0

    length: float = parameter(20.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    rms: float = parameter(0.5, "root mean square of the initial field", 0.0, 1e6)
    target_amplitude: float = parameter(0.2, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return 1j * k**3 + 1j * k**5

    def multiplier(self, k: Field) -> Spectrum:
        return -0.5j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.sin(2 * np.pi * x / self.length)


@dataclass(frozen=True, kw_only=True)
class BenjaminBonaMahony(RandomModes):
    """Benjamin-Bona-Mahony, u_t - u_xxt + u_x + u u_x = (1 - d_xx) a: rational in the wavenumber."""

    name: ClassVar[str] = "benjamin-bona-mahony"
    order: ClassVar[float] = 0.0

    length: float = parameter(20.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    target_amplitude: float = parameter(0.5, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return -1j * k / (1 + k**2)

    def multiplier(self, k: Field) -> Spectrum:
        return -0.5j * k / (1 + k**2)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.sin(2 * np.pi * x / self.length)


@dataclass(frozen=True, kw_only=True)
class SineReaction(RandomModes):
    """Reaction-diffusion, u_t - D u_xx - r sin(3 u) = a: no polynomial, many equilibria."""

    name: ClassVar[str] = "sine-reaction"
    order: ClassVar[float] = 2.0

    length: float = parameter(2.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    rms: float = parameter(0.8, "root mean square of the initial field", 0.0, 1e6)
    diffusivity: float = parameter(5e-3, "diffusivity D", 0.0, 1e3, "length^2/time")
    rate: float = parameter(2.0, "strength r of the reaction", 0.0, 1e3, "1/time")
    target_amplitude: float = parameter(0.5, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return -self.diffusivity * k**2

    def multiplier(self, k: Field) -> Spectrum:
        return np.full_like(k, self.rate)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return math.sin(3.0 * u)

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.cos(2 * np.pi * x / self.length)


@dataclass(frozen=True, kw_only=True)
class FractionalBurgers(RandomModes):
    """Burgers with fractional dissipation, u_t + u u_x + nu |k|^{3/2} u = a."""

    name: ClassVar[str] = "fractional-burgers"
    order: ClassVar[float] = 1.5

    rms: float = parameter(0.5, "root mean square of the initial field", 0.0, 1e6)
    viscosity: float = parameter(5e-3, "viscosity nu", 0.0, 1e3)
    target_amplitude: float = parameter(0.1, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return -self.viscosity * np.abs(k) ** 1.5

    def multiplier(self, k: Field) -> Spectrum:
        return -0.5j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.cos(2 * np.pi * x / self.length)


@dataclass(frozen=True, kw_only=True)
class SwiftHohenberg(RandomModes):
    """Swift-Hohenberg, u_t = r u - (1 + d_xx)^2 u - u^3 + a: patterns of one wavelength."""

    name: ClassVar[str] = "swift-hohenberg-modes"
    order: ClassVar[float] = 4.0

    length: float = parameter(8 * math.pi, "length L of the periodic domain", 1e-3, 1e6, "length")
    rms: float = parameter(0.8, "root mean square of the initial field", 0.0, 1e6)
    modes: float = parameter(8.0, "lowest Fourier modes J of the initial field", 1.0, 64.0)
    growth: float = parameter(0.6, "growth rate r of the pattern", -1e2, 1e2, "1/time")

    def linear_operator(self, k: Field) -> Spectrum:
        return self.growth - (1 - k**2) ** 2

    def multiplier(self, k: Field) -> Spectrum:
        return -np.ones_like(k)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u * u

    def target(self, x: Field) -> Field:
        return np.zeros_like(x)


@dataclass(frozen=True, kw_only=True)
class SteepTarget(RandomModes):
    """Burgers to a pair of fronts, z_r = 0.1 tanh(4 cos(2 pi x/L))."""

    name: ClassVar[str] = "burgers-fronts"
    order: ClassVar[float] = 2.0

    rms: float = parameter(0.5, "root mean square of the initial field", 0.0, 1e6)
    viscosity: float = parameter(1e-2, "viscosity nu", 0.0, 1e3, "length^2/time")

    def linear_operator(self, k: Field) -> Spectrum:
        return -self.viscosity * k**2

    def multiplier(self, k: Field) -> Spectrum:
        return -0.5j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def target(self, x: Field) -> Field:
        fronts: Field = 0.1 * np.tanh(4 * np.cos(2 * np.pi * x / self.length))
        return fronts


@dataclass(frozen=True, kw_only=True)
class AllenCahnUnequal(AllenCahnModes):
    """Allen-Cahn with actuators whose strengths are 0.5, 1 and 1.5 in turn."""

    name: ClassVar[str] = "allen-cahn-unequal"

    def supports(self, x: Field, n_a: int, width: float) -> Field:
        own: Field = indicator_supports(len(x), n_a, width) * (0.5 + np.arange(n_a) % 3 / 2)
        return own
