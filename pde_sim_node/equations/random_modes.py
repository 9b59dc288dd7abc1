# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The paper's three equations from initial fields with many random numbers instead of one or two."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations.base import Equation, Field, Spectrum, parameter


@dataclass(frozen=True, kw_only=True)
class RandomModes(Equation):
    """An equation whose initial fields are random sums of the lowest Fourier modes.

        u(x, 0) = rms / sqrt(J) sum_{j=1}^{J} (alpha_j cos(2 pi j x/L) + beta_j sin(2 pi j x/L))

    with independent alpha_j, beta_j ~ N(0, 1), so that rms is the root of the mean square of u over x
    and over the draws. The mean of the distribution is u = 0.

    To give an equation of your own such fields, derive it from this class instead of `Equation`.

    Examples
    --------
    >>> x = np.arange(64) / 32
    >>> fields = [AllenCahnModes().initial_field(x, np.random.default_rng(s)) for s in range(500)]
    >>> round(float(np.sqrt(np.mean(np.square(fields)))), 1)
    0.8
    """

    rms: float = parameter(1.0, "root mean square of the initial field", 0.0, 1e6)
    modes: float = parameter(4.0, "lowest Fourier modes J of the initial field", 1.0, 64.0)

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        if rng is None:
            return np.zeros_like(x)
        count = round(self.modes)
        cosines, sines = rng.standard_normal((2, count))
        phases = 2 * np.pi / self.length * np.outer(np.arange(1, count + 1), x)
        total = cosines @ np.cos(phases) + sines @ np.sin(phases)
        field: Field = self.rms / np.sqrt(count) * total
        return field


@dataclass(frozen=True, kw_only=True)
class BurgersModes(RandomModes):
    """The viscous Burgers equation, u_t + u u_x - nu u_xx = a, from random modes; see `Burgers`."""

    name: ClassVar[str] = "burgers-modes"
    order: ClassVar[float] = 2.0

    rms: float = parameter(0.5, "root mean square of the initial field", 0.0, 1e6)
    viscosity: float = parameter(1e-4, "viscosity nu", 0.0, 1e3, "length^2/time")
    target_amplitude: float = parameter(0.1, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return -self.viscosity * k**2

    def multiplier(self, k: Field) -> Spectrum:
        return -0.5j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.cos(2 * np.pi * x / self.length)


@dataclass(frozen=True, kw_only=True)
class AllenCahnModes(RandomModes):
    """Allen-Cahn, u_t - nu^2 u_xx + V (u^3 - u) = a, from random modes; see `AllenCahn`."""

    name: ClassVar[str] = "allen-cahn-modes"
    order: ClassVar[float] = 2.0

    length: float = parameter(2.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    rms: float = parameter(0.8, "root mean square of the initial field", 0.0, 1e6)
    diffusivity: float = parameter(5e-2, "diffusivity nu (enters squared)", 0.0, 1e3)
    potential: float = parameter(5.0, "strength V of the double-well potential", 0.0, 1e6, "1/time")
    target_amplitude: float = parameter(1.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return self.potential - self.diffusivity**2 * k**2

    def multiplier(self, k: Field) -> Spectrum:
        return np.full_like(k, -self.potential)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u * u

    def target(self, x: Field) -> Field:
        return -self.target_amplitude * np.cos(2 * np.pi * x / self.length)


@dataclass(frozen=True, kw_only=True)
class KortewegDeVriesModes(RandomModes):
    """Korteweg-de Vries, u_t + u_xxx - 6 u u_x = a, from random modes; see `KortewegDeVries`."""

    name: ClassVar[str] = "kdv-modes"
    order: ClassVar[float] = 3.0

    length: float = parameter(20.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    target_amplitude: float = parameter(1.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return 1j * k**3

    def multiplier(self, k: Field) -> Spectrum:
        return 3j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.sin(2 * np.pi * x / self.length)
