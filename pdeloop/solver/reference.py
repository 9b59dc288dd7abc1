# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The time step in plain NumPy, for readers: the same computation as the compiled `kernel`.

It is the step of `etdrk4` (equations and sources there) for the real FFT v of the state, with the
nonlinear part on the dealiased grid and the forcing of the held action, N(v) = m F[g(u)] + F_a.
"""

from typing import Any, Protocol

import numpy as np
from scipy.fft import irfft, rfft

from pdeloop.messages.arrays import Array
from pdeloop.solver.etdrk4 import Spectrum, etdrk4_coefficients


class SemilinearEquation(Protocol):
    """u_t = L u + m g(u) + sum_j Phi_j a_j on [0, length), as `pde_sim_node.equations.Equation`."""

    @property
    def length(self) -> float: ...
    def linear_operator(self, k: Array) -> Spectrum: ...
    def multiplier(self, k: Array) -> Spectrum: ...
    def nonlinearity(self, u: float) -> float: ...


class ReferenceStep:
    """ETDRK4 of a semilinear equation over all environments at once.

    Parameters
    ----------
    equation
        L(k), m(k), g(u) and the length of the domain.
    supports : (n_z, n_a) array
        Phi_j(x_i).
    integration_time
        Internal step of the integrator.
    steps
        Internal steps of a sampling time.
    fine
        Points of the dealiased grid; 3/2 n_z if not given.

    Examples
    --------
    The mean of a solution of Burgers' equation is conserved:

    >>> from pde_sim_node.equations import Burgers
    >>> step = ReferenceStep(Burgers(), np.zeros((64, 1)), integration_time=0.01, steps=5)
    >>> z = np.sin(2 * np.pi * np.arange(64) / 64)[np.newaxis]
    >>> bool(abs(step(z, np.zeros((1, 1))).mean()) < 1e-15)
    True
    """

    def __init__(
        self,
        equation: SemilinearEquation,
        supports: Array,
        *,
        integration_time: float,
        steps: int,
        fine: int | None = None,
    ) -> None:
        self.n_z, self.steps = len(supports), steps
        self.fine = fine or 3 * self.n_z // 2
        k = 2 * np.pi / equation.length * np.arange(self.n_z // 2 + 1, dtype=np.float64)
        self.coefficients = etdrk4_coefficients(equation.linear_operator(k), integration_time)
        # The transform of the fine grid is larger than that of the published one by their lengths.
        self.multiplier = equation.multiplier(k) * self.n_z / self.fine
        self.nonlinearity: Any = equation.nonlinearity
        self.supports = np.fft.rfft(supports, axis=0).T

    def __call__(self, states: Array, actions: Array) -> Array:
        """The states (M, n_z) one sampling time later, under the actions (M, n_a)."""
        c, forcing = self.coefficients, actions @ self.supports
        modes, scale = self.n_z // 2 + 1, self.fine / self.n_z

        def nonlinear(v: Any) -> Any:
            u = scale * irfft(v, self.fine)
            return self.multiplier * rfft(self.nonlinearity(u))[:, :modes] + forcing

        v = rfft(states)
        for _ in range(self.steps):
            n_v = nonlinear(v)
            a = c.e2 * v + c.q * n_v
            n_a = nonlinear(a)
            b = c.e2 * v + c.q * n_a
            n_b = nonlinear(b)
            n_c = nonlinear(c.e2 * a + c.q * (2 * n_b - n_v))
            v = c.e * v + c.f1 * n_v + 2 * c.f2 * (n_a + n_b) + c.f3 * n_c
        new: Array = irfft(v, self.n_z)
        return new
