# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Symbols of an equation from the regression of a pass; see `spectral_fit`.

Kinds, by their number of unknowns: polynomials of ik with real coefficients (`poly`, and `front` with
fewer terms), compared on low wavenumbers only, where a steep front has no influence; with the Hilbert
transforms of the derivatives in L (`nonlocal`); L free at every wavenumber (`semi`); all symbols free
(`free`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models.columns import Values
from pdeloop.method.models.settings import COEFFICIENT_RIDGE, FieldModelSettings
from pdeloop.method.models.spectral import Spectrum

_SYMBOL_RIDGE = 1e-7
"""Ridge of a free symbol, relative to the mean square of its column."""

ORDERS = (4, 2, 2, 1, 1, 1, 1)
"""Highest derivative in the symbols of z, z^2, ...; (ik)^3 of z^2 makes the first pass explode."""
Symbols = tuple[Spectrum, Spectrum, Array]
"""L, and m_q and C_qp as in `SpectralModel`."""


@dataclass(frozen=True, kw_only=True)
class Form:
    """The choice of an equation's symbols.

    Attributes
    ----------
    name : str
    degree : int
        P.
    linear_order : int
        Highest power of ik in L.
    shares : sequence of int
        For each pass, n: the lowest 1/n of the wavenumbers is compared. The last entry also holds
        for all further passes.
    hilbert : bool
        Whether L also has the Hilbert transforms of its derivatives.
    free : {"none", "linear", "all"}
        Symbols that are free at every wavenumber.
    """

    name: str
    degree: int
    linear_order: int = ORDERS[0]
    shares: tuple[int, ...] = (8, 8, 4)
    hilbert: bool = False
    free: str = "none"

    def compared(self, modes: int, turn: int | None = None) -> int:
        """Wavenumbers that are compared in a pass; without one, in the last."""
        if self.free == "all":
            return modes
        last = len(self.shares) - 1
        return max(4, modes // self.shares[last if turn is None else min(turn, last)])

    @property
    def unknowns(self) -> tuple[float, int]:
        """Those of every wavenumber, and the coefficients that all share."""
        shared = sum(order + 1 for order in ORDERS[1 : self.degree])
        if self.free == "all":
            return float(self.degree), 0
        if self.free == "linear":
            return 1.0, shared
        return 0.0, shared + (self.linear_order + 1) * (2 if self.hilbert else 1)


@dataclass(frozen=True, eq=False)
class Regression:
    """A pass: y = (L' - L) W_1 + sum_p sigma_p W_p + phi_1(L) F[B a + c], weighted.

    symbols (P, modes): the current ones, L first; y (N, modes); W (P, N, modes); phi (modes,); common
    (N, n_a + 1): the columns of B and c; free_of_common: orthonormal columns of their space; miss: by
    the residual of the current equation at the samples.
    """

    symbols: Spectrum
    y: Spectrum
    W: Spectrum
    phi: Spectrum
    common: Values
    free_of_common: Values
    miss: float

    def rest(self, values: Spectrum) -> Spectrum:
        """Values (N, ..) without what B and c explain."""
        q = self.free_of_common
        projected: Spectrum = values - q @ (q.T @ values)
        return projected

    def coefficients(
        self, columns: Spectrum, values: Spectrum, settings: FieldModelSettings
    ) -> Array:
        """Real coefficients of complex columns (N, terms) that explain values (N,) best."""
        return _real_least_squares(columns, values)

    @property
    def k(self) -> Spectrum:
        """ik, in units of the highest wavenumber."""
        modes = self.symbols.shape[1]
        wavenumbers: Spectrum = 1j * np.arange(modes) / modes
        return wavenumbers


def polynomial(data: Regression, form: Form, turn: int, settings: FieldModelSettings) -> Symbols:
    """Polynomials of ik."""
    k = data.k
    compared = min(form.compared(len(k), turn), data.y.shape[1])
    low = slice(compared)
    rests = [data.rest(W[:, low]) for W in data.W]
    terms = [(0, k**j) for j in range(form.linear_order + 1)]
    if form.hilbert:
        terms += [(0, 1j * np.sign(k.imag) * term) for _, term in terms]
    count = len(terms)
    powers = _power_terms(form)
    terms += [(p, k**j) for p, j in powers]
    columns = np.stack([(rests[p] * term[low]).ravel() for p, term in terms], axis=1)
    found = data.coefficients(columns, data.rest(data.y[:, low]).ravel(), settings)
    linear = data.symbols[0] + sum(
        coefficient * term for coefficient, (_, term) in zip(found[:count], terms, strict=False)
    )
    # Above what was compared, growth beyond that at its edge would be an artefact of extrapolation.
    most = max(float(linear[compared - 1].real), 0.0)
    high = np.arange(len(k)) >= compared
    linear = np.where(high, np.minimum(linear.real, most) + 1j * linear.imag, linear)
    return linear, *_grouped(form, powers, found[count:], k)


def free_linear(data: Regression, form: Form) -> Symbols:
    """L free at every wavenumber, and polynomials of ik for the powers."""
    k, compared = data.k, form.compared(len(data.k))
    rests, y = [data.rest(W) for W in data.W], data.rest(data.y)
    own = rests[0]
    size = np.sum(np.abs(own) ** 2, axis=0)
    size = size + _SYMBOL_RIDGE * np.mean(np.sum(np.abs(data.W[0]) ** 2, axis=0))
    size = np.where(size > 0.0, size, 1.0)

    def rest(values: Spectrum) -> Spectrum:
        projected: Spectrum = values - own * (np.sum(np.conj(own) * values, axis=0) / size)
        return projected

    powers, low = _power_terms(form), slice(compared)
    columns = np.stack([(rest(rests[p]) * k**j)[:, low].ravel() for p, j in powers], axis=1)
    found = _real_least_squares(columns, rest(y)[:, low].ravel())
    multipliers, polynomials = _grouped(form, powers, found, k)
    left = y - np.einsum("pk,pnk->nk", polynomials.T @ multipliers, np.stack(rests[1:]))
    linear = data.symbols[0] + np.sum(np.conj(own) * left, axis=0) / size
    most = max(float(linear.real[: max(4, len(k) // 8)].max()), 0.0)
    linear = np.minimum(linear.real, most) + 1j * linear.imag
    return _unwound(linear, compared), multipliers, polynomials


def all_free(data: Regression) -> Symbols:
    """All symbols free at every wavenumber, near the current ones where data do not determine them."""
    rests, y = np.stack([data.rest(W) for W in data.W]), data.rest(data.y)
    ridge = COEFFICIENT_RIDGE * np.sum(np.abs(data.W) ** 2, axis=1).T
    ridge = np.where(ridge > 0.0, ridge, 1.0)  # (wavenumbers, P)
    gram = np.einsum("pnk,qnk->kpq", np.conj(rests), rests)
    moment = np.einsum("pnk,nk->kp", np.conj(rests), y)
    known = data.symbols.T.copy()
    known[:, 0] = 0.0
    eye = np.eye(len(data.symbols))
    found = np.linalg.solve(gram + ridge[:, :, None] * eye, (moment + ridge * known)[..., None])
    symbols: Spectrum = found[..., 0].T
    linear = symbols[0] + data.symbols[0]
    most = max(0.5, float(data.symbols[0].real.max()))
    linear = np.minimum(linear.real, most) + 1j * linear.imag
    return linear, symbols[1:], np.eye(len(symbols) - 1)


def _power_terms(form: Form) -> list[tuple[int, int]]:
    """Indices p - 1 of the powers above the first, and orders of the derivative."""
    return [(p, j) for p in range(1, form.degree) for j in range(ORDERS[p] + 1)]


def _grouped(
    form: Form, terms: list[tuple[int, int]], found: Array, k: Spectrum
) -> tuple[Spectrum, Array]:
    """The powers of ik as multipliers, with their polynomials."""
    orders = np.arange(max((j for _, j in terms), default=-1) + 1)
    polynomials = np.zeros((len(orders), form.degree - 1))
    for (p, j), coefficient in zip(terms, found, strict=True):
        polynomials[j, p - 1] = coefficient
    return k ** orders[:, None], polynomials


def _unwound(linear: Spectrum, known: int) -> Spectrum:
    """L with multiples of 2 pi i such that it is continuous, from the wavenumber `known` on.

    Between two samples a fast wave turns more than once, and from its two ends one cannot see how
    often: a parabola through the wavenumbers below says it.
    """
    found, window = linear.copy(), min(8, known)
    x = np.arange(-window, 0)
    extrapolate = np.linalg.pinv(np.vander(x, 3))[2]  # the parabola at 0
    for k in range(known, len(found)):
        expected = extrapolate @ found[k - window : k].imag
        found[k] += 2j * np.pi * np.round((expected - found[k].imag) / (2 * np.pi))
    return found


def _real_least_squares(A: Spectrum, y: Spectrum) -> Array:
    """Real coefficients of complex columns."""
    scale = np.sqrt(np.sum(np.abs(A) ** 2, axis=0))
    scale = np.where(scale > 0.0, scale, 1.0)
    A = A / scale
    gram = (A.conj().T @ A).real + COEFFICIENT_RIDGE * np.eye(A.shape[1])
    found: Array = np.linalg.solve(gram, (A.conj().T @ y).real) / scale
    return found
