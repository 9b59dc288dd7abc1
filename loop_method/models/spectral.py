# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A partial differential equation with constant coefficients on a periodic grid, as a model.

    d/dt F[z] = L F[z] + sum_q m_q F[g_q(z)] + F[B a + c],        g_q(z) = sum_{p >= 2} C_qp z^p,

F the discrete Fourier transform, L and m_q numbers of every wavenumber, and time in sampling times. A
sampling time is integrated by ETDRK4 (`etdrk4`) in equal internal steps, and the nonlinear part on a
finer grid that has room for its products: 3/2 of the points for squares, 2 for cubes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft

from loop_interfaces.arrays import Array
from loop_method.models.base import Arrays, linearised, text_of
from spectral_solver.etdrk4 import Coefficients, etdrk4_coefficients

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class SpectralModel:
    """The equation above.

    Attributes
    ----------
    kind : str
    linear : (n_z // 2 + 1,) complex array
        L.
    multipliers : (Q, n_z // 2 + 1) complex array
        m_q; none of a linear equation.
    polynomials : (Q, P - 1) array
        C_qp, p = 2 .. P.
    B : (n_z, n_a) array
    constant : (n_z,) array
        c.
    substeps : int
        Internal steps of a sampling time.
    clip : float
        z is cut to +-clip in g_q; infinite: it is not.
    """

    kind: str
    linear: Spectrum
    multipliers: Spectrum
    polynomials: Array
    B: Array
    constant: Array
    substeps: int
    clip: float = np.inf

    @property
    def n_z(self) -> int:
        return len(self.constant)

    @property
    def n_a(self) -> int:
        return int(self.B.shape[1])

    @property
    def degree(self) -> int:
        """P."""
        return int(self.polynomials.shape[1]) + 1

    @property
    def symbols(self) -> Spectrum:
        """sigma_p = L for p = 1 and sum_q m_q C_qp for the powers above, (P, n_z // 2 + 1)."""
        return np.vstack([self.linear, self.polynomials.T @ self.multipliers])

    @property
    def fine(self) -> int:
        """Points of the grid of the nonlinear part."""
        return fine_points(self.n_z, self.degree)

    @cached_property
    def coefficients(self) -> Coefficients:
        """Those of an internal step."""
        return etdrk4_coefficients(self.linear, 1.0 / self.substeps)

    def step(self, states: Array, actions: Array) -> Array:
        v, force = rfft(states), self.force(actions)
        with np.errstate(all="ignore"):
            for _ in range(self.substeps):
                v = self._stages(v, force)[-1]
            after: Array = irfft(v, self.n_z)
        return after

    def path(self, states: Array, actions: Array) -> list[Spectrum]:
        """Transforms of the field at the internal steps of a sampling time, of the states first."""
        points, force = [rfft(states)], self.force(actions)
        with np.errstate(all="ignore"):
            for _ in range(self.substeps):
                points.append(self._stages(points[-1], force)[-1])
        return points

    def force(self, actions: Array) -> Spectrum:
        """F[B a + c]."""
        transform: Spectrum = rfft(np.einsum("mj,ij->mi", actions, self.B) + self.constant)
        return transform

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        c, force, v = self.coefficients, self.force(actions), rfft(states)
        tape = []
        with np.errstate(all="ignore"):
            for _ in range(self.substeps):
                *stages, v = self._stages(v, force)
                tape.append(stages)
            # Between a spectrum and the fine grid the modes have the weights 1, 2, 2, ..; on the
            # published grid the last one, where n_z is even, has the weight 1.
            even = self.n_z % 2 == 0
            own = rfft(covectors) / self.n_z
            if even:
                own[..., -1] = 0.5 * own[..., -1].real
            held = np.zeros_like(own)
            for n_v, n_a, n_b, n_c in reversed(tape):
                on_c = self._transposed(n_c, np.conj(c.f3) * own)
                on_b = self._transposed(n_b, 2 * np.conj(c.f2) * own + 2 * np.conj(c.q) * on_c)
                inner = 2 * np.conj(c.f2) * own + np.conj(c.q) * on_b
                on_a = self._transposed(n_a, inner) + np.conj(c.e2) * on_c
                held += np.conj(c.q) * (on_a + on_b + on_c)
                held += np.conj(c.f1 + 4 * c.f2 + c.f3) * own
                inner = np.conj(c.f1) * own + np.conj(c.q) * (on_a - on_c)
                own = np.conj(c.e2) * (on_a + on_b) + np.conj(c.e) * own
                own = own + self._transposed(n_v, inner)
            if even:
                own[..., -1] *= 2.0
                held[..., -1] *= 2.0
            on_states, on_force = (self.n_z * irfft(x, self.n_z) for x in (own, held))
            return on_states, np.einsum("mi,ij->mj", on_force, self.B)

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        return linearised(self, state, action)

    def arrays(self) -> Arrays:
        return {
            "form": np.array("spectral"),
            "kind": np.array(self.kind),
            "linear": self.linear,
            "multipliers": self.multipliers,
            "polynomials": self.polynomials,
            "B": self.B,
            "constant": self.constant,
            "substeps": np.array(self.substeps),
            "clip": np.array(self.clip),
        }

    @staticmethod
    def from_arrays(arrays: Arrays) -> SpectralModel:
        """The model of `arrays`."""
        names = ("linear", "multipliers", "polynomials", "B", "constant")
        given = [np.asarray(arrays[name]) for name in names]
        return SpectralModel(
            text_of(arrays, "kind"),
            *given,
            substeps=int(arrays["substeps"].item()),
            clip=float(arrays["clip"].item()),
        )

    def field(self, v: Spectrum) -> Array:
        """The field of a spectrum on the finer grid."""
        u: Array = irfft(v, self.fine) * (self.fine / self.n_z)
        return u

    def _nonlinear(self, u: Array) -> Spectrum:
        scale, total = self.n_z / self.fine, 0.0
        u = np.clip(u, -self.clip, self.clip)
        for multiplier, polynomial in zip(self.multipliers, self.polynomials, strict=True):
            g = np.zeros_like(u)
            for coefficient in polynomial[::-1]:
                g = (g + coefficient) * u
            total = total + multiplier * rfft(g * u)[..., : len(multiplier)] * scale
        return total

    def _stages(self, v: Spectrum, force: Spectrum) -> tuple[Array, Array, Array, Array, Spectrum]:
        """The fields of the four stages, and the spectrum an internal step later."""
        c = self.coefficients
        u_v = self.field(v)
        n_v = self._nonlinear(u_v) + force
        a = c.e2 * v + c.q * n_v
        u_a = self.field(a)
        n_a = self._nonlinear(u_a) + force
        b = c.e2 * v + c.q * n_a
        u_b = self.field(b)
        n_b = self._nonlinear(u_b) + force
        u_c = self.field(c.e2 * a + c.q * (2 * n_b - n_v))
        n_c = self._nonlinear(u_c) + force
        after = c.e * v + c.f1 * n_v + 2 * c.f2 * (n_a + n_b) + c.f3 * n_c
        return u_v, u_a, u_b, u_c, after

    def _transposed(self, u: Array, own: Spectrum) -> Spectrum:
        """The transposed derivative of the nonlinear part at a field u, of a covector."""
        inside = np.abs(u) <= self.clip
        u, total = np.clip(u, -self.clip, self.clip), np.zeros_like(u)
        powers = np.arange(2, self.degree + 1)
        for multiplier, polynomial in zip(self.multipliers, self.polynomials, strict=True):
            slope = np.zeros_like(u)
            for coefficient in (powers * polynomial)[::-1]:
                slope = (slope + coefficient) * u
            total += inside * slope * self.field(np.conj(multiplier) * own)
        product: Spectrum = rfft(total)[..., : own.shape[-1]] * (self.n_z / self.fine)
        return product


def fine_points(n_z: int, degree: int) -> int:
    """Points of the grid on which a polynomial of that degree is evaluated."""
    if degree < 2:
        return n_z
    return 2 * n_z if degree > 2 else 3 * n_z // 2 + n_z % 2
