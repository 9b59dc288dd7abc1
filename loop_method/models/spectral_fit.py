# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fit of an equation with constant coefficients to steps of a plant.

Over a sampling time, the unit of time,

    F[z_{k+1}] - e^L F[z_k] = sum_p sigma_p W_p + phi_1(L) F[B a_k + c],
    W_p = integral_0^1 e^{L (1 - s)} F[z(s)^p] ds,

is linear in the symbols sigma_p and, through sigma_1 W_1, in a change of L. What is between two samples
is integrated with the present equation (at first there is none) and bent linearly in time, so that it
ends in the measured z_{k+1}. So a pass is a linear regression, and a few passes suffice, without a
start: a plant moves the field far within a sampling time, but an equation from bent paths of the wrong
equation is nearly right. B and c are free at every wavenumber and are projected out first.

Kinds, by their number of unknowns: polynomials of ik with real coefficients (`poly`, `front`), compared
on low wavenumbers only, where a steep front has no influence; L free at every wavenumber (`semi`), for
plants with a nonlocal linear part; all symbols free (`free`).

References
----------
Messenger, Bortz, "Weak SINDy for partial differential equations", J. Comput. Phys. 443, 2021. Rudy,
Brunton, Proctor, Kutz, "Data-driven discovery of partial differential equations", Science Advances 3,
2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, rfft

from loop_interfaces.arrays import Array
from loop_method.models.base import Samples
from loop_method.models.columns import least_squares, orthonormal
from loop_method.models.settings import FieldModelSettings
from loop_method.models.spectral import SpectralModel, Spectrum
from spectral_solver.polynomial_step import phi_functions

ORDERS = (4, 2, 2, 1, 1, 1, 1)
"""Of the highest derivative in the symbols of z, z^2, ..; (ik)^3 of z^2 lets the first pass explode."""
GROUP = 3
"""From this degree on, multipliers are powers of ik, each with a polynomial, and not symbols."""


@dataclass(frozen=True, kw_only=True)
class Form:
    """Which symbols an equation has.

    Attributes
    ----------
    name : str
    degree : int
        P.
    linear_order : int
        Highest power of ik in L.
    shares : sequence of int
        In each pass, the last one in all others: one of so many wavenumbers is compared, the lowest.
    free : {"none", "linear", "all"}
        Symbols that are free at every wavenumber.
    """

    name: str
    degree: int
    linear_order: int = ORDERS[0]
    shares: tuple[int, ...] = (8, 8, 4)
    free: str = "none"

    @property
    def orders(self) -> tuple[int, ...]:
        """Of the highest derivative, for p = 1 .. P."""
        return (self.linear_order, *ORDERS[1 : self.degree])


@dataclass
class _Regression:
    """A pass: y, W (P, N, wavenumbers), phi_1, and the columns of B and c, weighted."""

    y: Spectrum
    W: Spectrum
    phi: Spectrum
    common: Array
    free_of_common: Array  # orthonormal columns of the space of `common`

    def rest(self, values: Spectrum) -> Spectrum:
        """Values (N, ..) without what B and c explain."""
        q = self.free_of_common
        projected: Spectrum = values - q @ (q.T @ values)
        return projected


def fit_spectral(
    samples: Samples, form: Form, settings: FieldModelSettings
) -> SpectralModel | None:
    """The equation of that form, or None where half of the samples overflow the first ones."""
    samples = samples.thinned(settings.samples)
    n_z, n_a = samples.before.shape[1], samples.actions.shape[1]
    modes, largest = n_z // 2 + 1, float(np.abs(samples.before).max())
    k = 1j * np.arange(modes) / modes
    symbols = np.zeros((form.degree, modes), complex)
    B, constant, substeps = np.zeros((n_z, n_a)), np.zeros(n_z), settings.first_substeps
    clip = settings.clip * largest if form.degree > 3 else np.inf
    model: SpectralModel | None = None
    for turn in range(settings.passes):
        now = _model(form, symbols, B, constant, substeps, clip)
        regression = _regression(now, samples)
        if regression is None:
            break
        if form.free == "none" or (form.free == "linear" and turn < settings.passes // 2):
            compared = max(4, modes // form.shares[min(turn, len(form.shares) - 1)])
            new = _polynomial(regression, symbols, form, k, compared, settings)
        elif form.free == "linear":
            new = _free_linear(regression, symbols, form, k, settings)
        else:
            new = _all_free(regression, symbols, settings)
        if not np.isfinite(new).all():
            break
        left = regression.y - (new[0] - symbols[0]) * regression.W[0]
        left = left - np.einsum("pk,pnk->nk", new[1:], regression.W[1:])
        inputs = n_z * irfft(least_squares(regression.common, left) / regression.phi, n_z)
        if not np.isfinite(inputs).all():
            break
        symbols, B, constant = new, inputs[:-1].T, inputs[-1]
        substeps = _substeps(symbols, largest, settings)
        model = _model(form, symbols, B, constant, substeps, clip)
    return model


def _model(
    form: Form, symbols: Spectrum, B: Array, constant: Array, substeps: int, clip: float
) -> SpectralModel:
    linear, powers = symbols[0], symbols[1:]
    polynomials = np.eye(len(powers))
    return SpectralModel(form.name, linear, powers, polynomials, B, constant, substeps, clip)


def _regression(model: SpectralModel, samples: Samples) -> _Regression | None:
    """The pass along the paths of a model; None where it overflows for half of the samples."""
    L = model.linear
    with np.errstate(all="ignore"):
        try:
            W = model.compiled.integrals(samples.before, samples.actions, samples.after)
        except ValueError:  # it grows beyond all bounds within a substep
            return None
        before, after = (rfft(z) / model.n_z for z in (samples.before, samples.after))
        y, phi = after - np.exp(L) * before, phi_functions(L)[0].astype(np.complex128)
    ok = np.isfinite(y).all(axis=1) & np.isfinite(W).all(axis=(0, 2))
    if 2 * ok.sum() < len(samples) or not np.isfinite(phi).all():
        return None
    root = samples.weights()[:, None]
    common = np.hstack([root * samples.actions, root])[ok]
    return _Regression(
        y=(root * y)[ok],
        W=(root * W)[:, ok],
        phi=phi,
        common=common,
        free_of_common=orthonormal(common),
    )


def _polynomial(
    data: _Regression,
    symbols: Spectrum,
    form: Form,
    k: Spectrum,
    compared: int,
    settings: FieldModelSettings,
) -> Spectrum:
    low = slice(compared)
    rests = [data.rest(W[:, low]) for W in data.W]
    terms = [(p, j) for p, order in enumerate(form.orders) for j in range(order + 1)]
    columns = np.stack([(rests[p] * k[low] ** j).ravel() for p, j in terms], axis=1)
    found = _real_least_squares(columns, data.rest(data.y[:, low]).ravel(), settings)
    new = np.zeros_like(symbols)
    new[0] = symbols[0]
    for (p, j), coefficient in zip(terms, found, strict=True):
        new[p] += coefficient * k**j
    high = np.arange(len(k)) >= compared
    new[0] = np.where(high, np.minimum(new[0].real, 0.0) + 1j * new[0].imag, new[0])
    return new


def _free_linear(
    data: _Regression, symbols: Spectrum, form: Form, k: Spectrum, settings: FieldModelSettings
) -> Spectrum:
    rests, y = [data.rest(W) for W in data.W], data.rest(data.y)
    own = rests[0]
    size = np.sum(np.abs(own) ** 2, axis=0)
    size = size + settings.symbol_ridge * np.mean(np.sum(np.abs(data.W[0]) ** 2, axis=0))
    size = np.where(size > 0.0, size, 1.0)

    def rest(values: Spectrum) -> Spectrum:
        projected: Spectrum = values - own * (np.sum(np.conj(own) * values, axis=0) / size)
        return projected

    terms = [(p, j) for p, order in enumerate(form.orders) if p for j in range(order + 1)]
    columns = np.stack([(rest(rests[p]) * k**j).ravel() for p, j in terms], axis=1)
    found = _real_least_squares(columns, rest(y).ravel(), settings)
    new = np.zeros_like(symbols)
    for (p, j), coefficient in zip(terms, found, strict=True):
        new[p] += coefficient * k**j
    left = y - sum(new[p] * rests[p] for p in range(1, form.degree))
    new[0] = symbols[0] + np.sum(np.conj(own) * left, axis=0) / size
    most = max(float(new[0].real[: max(4, len(k) // 8)].max()), 0.0)
    new[0] = np.minimum(new[0].real, most) + 1j * new[0].imag
    new[0, -1] = new[0, -1].real
    return new


def _all_free(data: _Regression, symbols: Spectrum, settings: FieldModelSettings) -> Spectrum:
    rests, y = np.stack([data.rest(W) for W in data.W]), data.rest(data.y)
    ridge = settings.coefficient_ridge * np.sum(np.abs(data.W) ** 2, axis=1).T
    ridge = np.where(ridge > 0.0, ridge, 1.0)  # (wavenumbers, P)
    gram = np.einsum("pnk,qnk->kpq", np.conj(rests), rests)
    moment = np.einsum("pnk,nk->kp", np.conj(rests), y)
    known = symbols.T.copy()
    known[:, 0] = 0.0
    eye = np.eye(len(symbols))
    found = np.linalg.solve(gram + ridge[:, :, None] * eye, (moment + ridge * known)[..., None])
    new: Spectrum = found[..., 0].T.copy()
    new[0] += symbols[0]
    most = max(0.5, float(symbols[0].real.max()))
    new[0] = np.minimum(new[0].real, most) + 1j * new[0].imag
    return new


def _real_least_squares(A: Spectrum, y: Spectrum, settings: FieldModelSettings) -> Array:
    """Real coefficients of complex columns."""
    scale = np.sqrt(np.sum(np.abs(A) ** 2, axis=0))
    scale = np.where(scale > 0.0, scale, 1.0)
    A = A / scale
    gram = (A.conj().T @ A).real + settings.coefficient_ridge * np.eye(A.shape[1])
    found: Array = np.linalg.solve(gram, (A.conj().T @ y).real) / scale
    return found


def _substeps(symbols: Spectrum, largest: float, settings: FieldModelSettings) -> int:
    """So many that the fastest rate of the nonlinear part, of what is dealiased, is followed."""
    if len(symbols) < 2:
        return 1
    z = np.linspace(-largest, largest, 41)[:, None]
    slopes = sum(p * z ** (p - 1) * symbols[p - 1] for p in range(2, len(symbols) + 1))
    rate = np.abs(slopes).max(axis=0)[: 2 * symbols.shape[1] // 3].max()
    steps = np.ceil(np.nan_to_num(rate) / settings.reach)
    return int(np.clip(steps, 1, settings.substeps))
