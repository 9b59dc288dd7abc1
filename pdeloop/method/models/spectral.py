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
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import Arrays, StoredModel, checked_substeps, shaped, text_of
from pdeloop.solver.polynomial_step import Polynomials, PolynomialStep

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class SpectralModel(StoredModel):
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

    FORM = "spectral"
    SHAPES: ClassVar = {
        "constant": "n",
        "linear": "c:m",
        "multipliers": "c:q m",
        "polynomials": "q p",
        "B": "n a",
        "substeps": "i:",
        "clip": "inf:",
        "fewer": "s 2",
    }
    OF_X: ClassVar = {"factors": "c:l m", "coefficients": "l d n"}
    """Of terms whose coefficients depend on x, where there are any."""
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

    def arrays(self) -> Arrays:
        of_x = {name: getattr(self, name) for name in self.OF_X}
        return super().arrays() | {name: own for name, own in of_x.items() if own is not None}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Self:
        shapes = SpectralModel.SHAPES
        if any(name in arrays for name in cls.OF_X):
            shapes = shapes | cls.OF_X
        make: Any = cls
        model: Self = make(kind=text_of(arrays, "kind"), **shaped(arrays, shapes))
        checked_substeps(model.substeps)
        if len(model.linear) != model.n_z // 2 + 1:
            raise ValueError(f"a model of {model.n_z} points has {len(model.linear)} wavenumbers")
        if model.coefficients is not None and model.coefficients.shape[1] != model.degree:
            raise ValueError(f"a model of degree {model.degree} has other coefficients of x")
        if ((model.fewer[:, 1] < 1) | (model.fewer[:, 1] > model.substeps)).any():
            raise ValueError(
                f"a model has other than 1 to {model.substeps} internal steps for some fields"
            )
        return model
