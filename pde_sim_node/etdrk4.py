"""Exponential time differencing, fourth-order Runge-Kutta: coefficients and integrator."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .equations import Equation, Spectrum

__all__ = ["Coefficients", "Integrator", "contour_coefficients"]

CONTOUR_POINTS = 32


@dataclass(frozen=True)
class Coefficients:
    """The ETDRK4 coefficients of one internal step, each (n_z//2 + 1,), real for a real linear operator."""

    e: Spectrum
    e2: Spectrum
    q: Spectrum
    f1: Spectrum
    f2: Spectrum
    f3: Spectrum


def contour_coefficients(linear: Spectrum, dt: float) -> Coefficients:
    """Coefficients by Kassam & Trefethen's mean over a circle around dt L."""
    z = dt * np.asarray(linear, dtype=np.complex128)[:, None]
    angle = 2 * np.pi * (np.arange(CONTOUR_POINTS) + 0.5) / CONTOUR_POINTS
    # The circle must keep away from 0, where the formulas cancel: go round it, or stay short of it.
    y = z + np.where(np.abs(z) < 1, 2.0, 0.5) * np.exp(1j * angle)
    exp = np.exp(y)
    values = (
        np.exp(z[:, 0]),
        np.exp(z[:, 0] / 2),
        dt * np.mean((np.exp(y / 2) - 1) / y, axis=1),
        dt * np.mean((-4 - y + exp * (4 - 3 * y + y**2)) / y**3, axis=1),
        dt * np.mean((2 + y + exp * (y - 2)) / y**3, axis=1),
        dt * np.mean((-4 - 3 * y - y**2 + exp * (4 - y)) / y**3, axis=1),
    )
    if np.isrealobj(linear):
        values = tuple(value.real.copy() for value in values)
    return Coefficients(*values)


class Integrator:
    """z_{k+1} = f(z_k, a_k) of one equation on one grid."""

    def __init__(
        self,
        equation: Equation,
        *,
        n_z: int,
        supports: NDArray[np.float64],
        integration_time: float,
        steps: int,
    ) -> None:
        k = 2 * np.pi * np.arange(n_z // 2 + 1) / equation.length
        self.c = contour_coefficients(equation.linear_operator(k), integration_time)
        self.m = equation.multiplier(k)
        self.g = equation.nonlinearity
        self.n_z, self.steps = n_z, steps
        self.forcing = np.fft.rfft(supports, axis=0)

    def advance(self, states: NDArray[np.float64], actions: NDArray[np.float64]) -> NDArray[np.float64]:
        n_z, fine, c = self.n_z, 3 * self.n_z // 2, self.c
        out = np.empty_like(states)
        with np.errstate(all="ignore"):
            for i, state in enumerate(states):
                force = (self.forcing * actions[i]).sum(axis=1)

                def nonlinear(v, force=force):
                    u = 1.5 * np.fft.irfft(v, fine)
                    return self.m * (np.fft.rfft(self.g(u))[: n_z // 2 + 1] / 1.5) + force

                v = np.fft.rfft(state)
                for _ in range(self.steps):
                    n0 = nonlinear(v)
                    a = c.e2 * v + c.q * n0
                    na = nonlinear(a)
                    b = c.e2 * v + c.q * na
                    nb = nonlinear(b)
                    d = c.e2 * a + c.q * (2 * nb - n0)
                    nd = nonlinear(d)
                    v = c.e * v + c.f1 * n0 + 2 * c.f2 * (na + nb) + c.f3 * nd
                out[i] = np.fft.irfft(v, n_z)
        return out
