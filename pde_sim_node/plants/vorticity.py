# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Kolmogorov flow: two-dimensional turbulence on a periodic square, driven by a shear force.

    w_t + u . grad w = nu lap w - chi n cos(n y) + sum_j Phi_j(x, y) a_j,    u = (psi_y, -psi_x)

with the stream function lap psi = -w on [0, 2 pi]^2. The laminar flow w = -chi/(nu n) cos(n y) is to be
held; for n > 1 it is unstable at large Reynolds numbers sqrt(chi) / nu. The inputs are vortices of
Gaussian shape and mean zero.

Pseudo-spectral, without the waves beyond two thirds of the shortest in products; the classical
Runge-Kutta scheme with the viscosity as integrating factor: fourth order in time.

References
----------
Chandler, Kerswell, "Invariant recurrent solutions embedded in a turbulent two-dimensional Kolmogorov
flow", J. Fluid Mech. 722, 2013. Canuto et al., "Spectral Methods", Springer 2006.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pde_sim_node.arguments import internal_steps, positive, whole
from pde_sim_node.dynamics import Dynamics, arguments_of
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Axis, Grid


class Kolmogorov(Dynamics):
    """A shear flow to be kept laminar.

    Parameters
    ----------
    points
        Of each axis.
    viscosity
        nu.
    force, waves
        chi and n of the force chi sin(n y) along x.
    across
        Actuators along each axis.
    spread
        Root mean square of the random waves that an episode begins with, about the laminar flow.
    step_time
        Internal time step, of which sample_time is a whole multiple.

    Raises
    ------
    ValueError
        A value is out of its range; the message names it.
    """

    sample_time, horizon, batched = 0.2, 100, True
    state_weight, action_weight = 1e-3, 1e-2
    grid: Grid

    def __init__(
        self,
        points: int = 32,
        viscosity: float = 0.05,
        force: float = 0.1,
        waves: int = 2,
        across: int = 4,
        spread: float = 0.2,
        step_time: float = 0.05,
    ) -> None:
        n = whole("points", points, 8)
        axes = (Axis(name, 2 * np.pi, n, periodic=True) for name in "yx")
        self.grid, self.spread = Grid(tuple(axes), ("vorticity",)), spread
        self.nu, self._dt = positive("viscosity", viscosity), positive("step_time", step_time)
        self._steps = internal_steps(self.sample_time, self._dt)
        self.n_a = whole("across", across, 1) ** 2
        x = self.grid.axes[0].points
        self._kx, self._ky = np.fft.rfftfreq(n, 1 / n), np.fft.fftfreq(n, 1 / n)[:, None]
        self._squares = self._kx**2 + self._ky**2
        self._kept = (np.abs(self._kx) < n / 3) & (np.abs(self._ky) < n / 3)
        self._inverse = np.where(self._squares > 0, 1.0 / np.maximum(self._squares, 1.0), 0.0)
        self._half = np.exp(-0.5 * self._dt * self.nu * self._squares)
        self._driving = np.tile(
            -force * waves * np.cos(whole("waves", waves, 1) * x)[:, None], (1, n)
        )
        self.target = (self._driving / (self.nu * waves**2)).ravel()
        centres = 2 * np.pi * (np.arange(across) + 0.5) / across
        far = np.abs(x - centres[:, None])
        bump = np.exp(-0.5 * (np.minimum(far, 2 * np.pi - far) * across / (0.5 * np.pi)) ** 2)
        vortices = np.einsum("iy,jx->ijyx", bump, bump).reshape(self.n_a, n, n)
        self._vortices = vortices - vortices.mean(axis=(1, 2), keepdims=True)
        self.supports = self._vortices.reshape(self.n_a, -1).T

    def initial_state(self, rng: np.random.Generator) -> Array:
        """The laminar flow and random waves of lengths from 2 pi / 3 on."""
        spectrum = rng.standard_normal(self._squares.shape) + 1j * rng.standard_normal(
            self._squares.shape
        )
        low = (self._squares > 0) & (np.abs(self._kx) <= 3) & (np.abs(self._ky) <= 3)
        field = np.fft.irfft2(np.where(low, spectrum, 0.0), s=self.grid.shape)
        drawn: Array = self.target + (self.spread * field / np.sqrt(np.mean(field**2))).ravel()
        return drawn

    def mean_state(self) -> Array:
        """The laminar flow and a wave of length 2 pi along x."""
        wave = np.cos(self.grid.axes[1].points)
        raised: Array = self.target + self.spread * np.tile(wave, (self.grid.shape[0], 1)).ravel()
        return raised

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        from scipy.fft import irfft2, rfft2  # which only some plants need

        force = np.tile(self._driving, (len(z), 1, 1))
        for j, vortex in enumerate(self._vortices):
            force += a[:, j, None, None] * vortex
        w, forced = rfft2(self.grid.fields(z)[:, 0]), rfft2(force)
        dt, E = self._dt, self._half
        for _ in range(self._steps):
            k1 = self._rates(w, forced)
            k2 = self._rates(E * (w + 0.5 * dt * k1), forced)
            k3 = self._rates(E * w + 0.5 * dt * k2, forced)
            k4 = self._rates(E * (E * w + dt * k3), forced)
            w = E * (E * (w + dt / 6 * k1) + dt / 3 * (k2 + k3)) + dt / 6 * k4
        after: Array = irfft2(w, s=self.grid.shape).reshape(len(z), -1)
        return after

    def _rates(self, w: Any, forced: Any) -> Any:
        """The transform of -u . grad w and the forces, without the viscosity."""
        from scipy.fft import irfft2, rfft2

        w = w * self._kept
        kx, ky, shape = 1j * self._kx, 1j * self._ky, self.grid.shape
        u, v = irfft2(ky * self._inverse * w, s=shape), irfft2(-kx * self._inverse * w, s=shape)
        carried = u * irfft2(kx * w, s=shape) + v * irfft2(ky * w, s=shape)
        return forced - self._kept * rfft2(carried)

    def refined(self) -> Kolmogorov:
        """With half the internal time step."""
        return type(self)(**{**arguments_of(self), "step_time": self._dt / 2})
