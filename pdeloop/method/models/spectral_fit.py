# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fit of an equation with constant coefficients to steps of a plant.

Over a sampling time, the unit of time,

    F[z_{k+1}] - e^L F[z_k] = sum_p sigma_p W_p + phi_1(L) F[B a_k + c],
    W_p = integral_0^1 e^{L (1 - s)} F[z(s)^p] ds,

is linear in the symbols sigma_p and, through sigma_1 W_1, in a change of L. The path between two
samples is integrated with the current equation (at first there is none), and corrected linearly in time
so that it ends in the measured z_{k+1}. So a pass is a linear regression, and a few passes suffice
without an initial guess: the field changes much within a sampling time, but corrected paths of a wrong
equation already give a nearly right one. B and c are free at every wavenumber and are projected out
first. A pass need not be a contraction where the field changes fast, so the equation with the smallest
residual of all passes is selected.

References
----------
Messenger, Bortz, "Weak SINDy for partial differential equations", J. Comput. Phys. 443, 2021. Rudy,
Brunton, Proctor, Kutz, "Data-driven discovery of partial differential equations", Science Advances 3,
2017.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy  # whose transforms, a tenth of a start, load when they are used
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import Samples
from pdeloop.method.models.columns import least_squares, orthonormal
from pdeloop.method.models.settings import FIRST_SUBSTEPS, FieldModelSettings
from pdeloop.method.models.spectral import SpectralModel, Spectrum
from pdeloop.method.models.symbols import Form, Regression, all_free, free_linear, polynomial
from pdeloop.solver.polynomial_step import phi_functions

_SETTLED = 1e-3
"""Relative change of the one-step error at which the passes end."""

POWERS = 3
"""Above this degree the multipliers are powers of ik, each with a polynomial; else they are symbols."""
SIZES = 48
"""Sizes of fields for which the steps are counted."""


def fit_spectral(
    samples: Samples, form: Form, settings: FieldModelSettings
) -> SpectralModel | None:
    """The equation of that form, or None where half of the samples overflow the first ones."""
    samples = samples.thinned(settings.samples)
    start = None
    if form.free == "linear":  # whose passes need one
        start = fit_spectral(samples, replace(form, free="none"), settings)
    (_, n_z), n_a = samples.before.shape, samples.actions.shape[1]
    largest = float(np.abs(samples.before).max())
    model = start or SpectralModel(
        form.name,
        np.zeros(n_z // 2 + 1, complex),
        np.zeros((form.degree - 1, n_z // 2 + 1), complex),
        np.eye(form.degree - 1),
        np.zeros((n_z, n_a)),
        np.zeros(n_z),
        FIRST_SUBSTEPS,
        settings.clip * largest if form.degree > POWERS else np.inf,
    )
    # `tried` is what the pass is about: an equation that is kept, and from then on `model`, or not.
    best, least, tried = None, np.inf, model
    for turn in range(settings.passes + 1):
        data = _regression(tried, samples, form)
        if data is None and best is None:
            break
        settled = data is not None and abs(data.miss - least) <= _SETTLED * least
        if data is not None and data.miss < least and turn:
            best, least = tried, data.miss
        if turn == settings.passes or (settled and turn > len(form.shares)):
            break
        if data is not None and (tried is best or turn <= len(form.shares)):
            model, found = tried, _pass(data, tried, form, turn, settings)
        else:
            found = _between(best or model, tried)  # half of the way
        if found is None:
            break
        tried = replace(found, substeps=substeps_of(found.symbols, largest, settings))
    if best is None:
        return None
    return replace(best, fewer=fewer_of(best.symbols, largest, best.substeps, settings))


def _between(first: SpectralModel, second: SpectralModel) -> SpectralModel:
    """The equation in the middle of two of the same form."""
    middle = {
        name: 0.5 * (getattr(first, name) + getattr(second, name))
        for name in ("linear", "multipliers", "polynomials", "B", "constant")
    }
    return replace(second, **middle)


def _pass(
    data: Regression, model: SpectralModel, form: Form, turn: int, settings: FieldModelSettings
) -> SpectralModel | None:
    """The equation of a regression; None where it is not finite."""
    if form.free == "all":
        linear, multipliers, polynomials = all_free(data)
    elif form.free == "linear":
        linear, multipliers, polynomials = free_linear(data, form)
    else:
        linear, multipliers, polynomials = polynomial(data, form, turn, settings)
    if form.degree <= POWERS:
        multipliers, polynomials = polynomials.T @ multipliers, np.eye(form.degree - 1)
    symbols = polynomials.T @ multipliers
    left = data.y - (linear - data.symbols[0]) * data.W[0]
    left = left - np.einsum("pk,pnk->nk", symbols, data.W[1:])
    inputs = model.n_z * scipy.fft.irfft(least_squares(data.common, left) / data.phi, model.n_z)
    if not (np.isfinite(linear).all() and np.isfinite(symbols).all() and np.isfinite(inputs).all()):
        return None
    return replace(
        model,
        kind=form.name,
        linear=linear,
        multipliers=multipliers,
        polynomials=polynomials,
        B=inputs[:-1].T,
        constant=inputs[-1],
    )


def _regression(model: SpectralModel, samples: Samples, form: Form) -> Regression | None:
    """What is known along the paths of a model; None where it overflows for half of the samples."""
    L, even = model.linear, replace(model, substeps=model.substeps + model.substeps % 2)
    with np.errstate(all="ignore"):
        try:
            W, miss = even.compiled.integrals(samples.before, samples.actions, samples.after)
        except ValueError:  # it grows beyond all bounds within a substep
            return None
        before, after = (scipy.fft.rfft(z) / model.n_z for z in (samples.before, samples.after))
        y, phi = after - np.exp(L) * before, phi_functions(L)[0]
    ok = (
        np.isfinite(y).all(axis=1) & np.isfinite(W).all(axis=(0, 2)) & np.isfinite(miss).all(axis=1)
    )
    if 2 * ok.sum() < len(samples) or not np.isfinite(phi).all():
        return None
    root = samples.weights()[:, None]
    missed = (root * miss)[ok, : form.compared(miss.shape[1])]
    common = np.hstack([root * samples.actions, root])[ok]
    return Regression(
        symbols=model.symbols,
        y=(root * y)[ok],
        W=(root * W)[:, ok],
        phi=phi.astype(complex),
        common=common,
        free_of_common=orthonormal(common),
        miss=float(np.sqrt(np.mean(np.sum(np.abs(missed) ** 2, axis=1)))),
    )


def substeps_of(symbols: Spectrum, largest: float, settings: FieldModelSettings) -> int:
    """Enough substeps to follow the fastest rate of the dealiased nonlinear part."""
    return int(_counts(symbols, largest, settings)[-1])


def fewer_of(symbols: Spectrum, largest: float, most: int, settings: FieldModelSettings) -> Array:
    """`fewer` of a `SpectralModel`: each row has about half as many steps again as the one before."""
    counts, rows, steps = _counts(symbols, largest, settings), [], 1
    while steps < most:
        if enough := int(np.sum(counts <= steps)):
            rows.append((largest * enough / SIZES, steps))
        steps += max(steps // 2, 1)
    return np.array(rows).reshape(-1, 2)


def _counts(symbols: Spectrum, largest: float, settings: FieldModelSettings) -> NDArray[np.int64]:
    """Internal steps, at least, of fields with max |z| = largest n/SIZES, n = 1 .. SIZES."""
    if len(symbols) < 2:
        return np.ones(SIZES, dtype=np.int64)
    size = largest * np.arange(1, SIZES + 1) / SIZES
    z = np.stack([size, -size])[..., None]
    low = symbols[:, : 2 * symbols.shape[1] // 3]
    slopes = sum(p * z ** (p - 1) * low[p - 1] for p in range(2, len(symbols) + 1))
    rates = np.nan_to_num(np.abs(slopes).max(axis=(0, 2)))
    steps = np.ceil(np.maximum.accumulate(rates) / settings.reach)
    return np.clip(steps, 1, settings.substeps).astype(np.int64)
