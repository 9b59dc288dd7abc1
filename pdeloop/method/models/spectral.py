# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A partial differential equation on a periodic grid, as a model.

    d/dt F[z] = L F[z] + sum_q m_q F[g_q(z)] + F[B a + c],        g_q(z) = sum_{p >= 2} C_qp z^p,

and, where coefficients depend on x, sum_l n_l F[h_l(x, z)] in addition, h_l = sum_p c_lp(x) z^p.
F is the discrete Fourier transform, L, m_q and n_l numbers of every wavenumber, and time in sampling
times. A sampling time is integrated by ETDRK4 in equal internal steps, the fewer the smaller the field,
and the nonlinear part on a finer grid that has room for its products, by the solver of the plants
(`pdeloop.solver.polynomial_step`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import Arrays, linearised, numbers_of, steps_of, text_of
from pdeloop.solver.polynomial_step import Polynomials, PolynomialStep

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
        z is cut to +-clip in g_q and h_l; infinite: it is not.
    fewer : (n, 2) array
        Rows max |z|, steps, both ascending: as many are enough where the field begins no larger.
    factors, coefficients : (N, n_z // 2 + 1) complex and (N, P, n_z) arrays, or None
        n_l and c_lp; None: there are none.
    """

    kind: str
    linear: Spectrum
    multipliers: Spectrum
    polynomials: Array
    B: Array
    constant: Array
    substeps: int
    clip: float = np.inf
    fewer: Array = field(default_factory=lambda: np.empty((0, 2)))
    factors: Spectrum | None = None
    coefficients: Array | None = None

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

    @cached_property
    def compiled(self) -> PolynomialStep:
        """Its step in machine code, which one thread may use at a time."""
        return self._compiled(self.substeps)

    @cached_property
    def steps(self) -> list[PolynomialStep]:
        """With the steps of each row of `fewer`, and with all of them."""
        return [*(self._compiled(int(steps)) for steps in self.fewer[:, 1]), self.compiled]

    def _compiled(self, substeps: int) -> PolynomialStep:
        equation = Polynomials(
            self.linear,
            self.multipliers,
            self.polynomials,
            self.B,
            self.constant,
            substeps,
            self.clip,
            self.factors,
            self.coefficients,
        )
        return PolynomialStep(equation)

    def _alike(self, states: Array) -> Iterator[tuple[PolynomialStep, slice | NDArray[np.bool_]]]:
        """The rows of states that are stepped alike, and by what."""
        level = np.searchsorted(self.fewer[:, 0], np.abs(states).max(axis=1, initial=0.0))
        level = np.minimum(level, len(self.fewer))  # NaN is beyond infinity
        for i in dict.fromkeys(level.tolist()):
            alike = level == i
            yield self.steps[i], slice(None) if alike.all() else alike

    def step(self, states: Array, actions: Array) -> Array:
        after = np.empty(states.shape)
        for alike, rows in self._alike(states):
            after[rows] = alike.step(states[rows], actions[rows])
        return after

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        on_states, on_actions = np.empty(states.shape), np.empty(actions.shape)
        for alike, rows in self._alike(states):
            on_states[rows], on_actions[rows] = alike.pull_back(
                states[rows], actions[rows], covectors[rows]
            )
        return on_states, on_actions

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        return linearised(self, state, action)

    def arrays(self) -> Arrays:
        of_x = {"factors": self.factors, "coefficients": self.coefficients}
        known = {name: value for name, value in of_x.items() if value is not None}
        return known | {
            "form": np.array("spectral"),
            "kind": np.array(self.kind),
            "linear": self.linear,
            "multipliers": self.multipliers,
            "polynomials": self.polynomials,
            "B": self.B,
            "constant": self.constant,
            "substeps": np.array(self.substeps),
            "clip": np.array(self.clip),
            "fewer": self.fewer,
        }

    @staticmethod
    def from_arrays(arrays: Arrays) -> SpectralModel:
        """The model of `arrays`."""
        constant = numbers_of(arrays, "constant", None)
        n_z, modes = len(constant), len(constant) // 2 + 1
        multipliers = _spectrum_of(arrays, "multipliers", None, modes)
        polynomials = numbers_of(arrays, "polynomials", len(multipliers), None)
        factors = coefficients = None
        if "factors" in arrays or "coefficients" in arrays:
            factors = _spectrum_of(arrays, "factors", None, modes)
            shape = len(factors), polynomials.shape[1] + 1, n_z
            coefficients = numbers_of(arrays, "coefficients", *shape)
        substeps, fewer = steps_of(arrays), numbers_of(arrays, "fewer", None, 2)
        if ((fewer[:, 1] < 1) | (fewer[:, 1] > substeps)).any():
            raise ValueError(
                f"a model has other than 1 to {substeps} internal steps for some fields"
            )
        return SpectralModel(
            text_of(arrays, "kind"),
            _spectrum_of(arrays, "linear", modes),
            multipliers,
            polynomials,
            numbers_of(arrays, "B", n_z, None),
            constant,
            substeps=substeps,
            clip=float(checked_array(arrays, "clip", "f", (), finite=False)),
            fewer=fewer,
            factors=factors,
            coefficients=coefficients,
        )


def _spectrum_of(arrays: Arrays, name: str, *shape: int | None) -> Spectrum:
    return checked_array(arrays, name, "c", shape)
