# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fit of an equation with constant coefficients to rollouts with measurement noise.

The regression of `spectral_fit` fails with noise for two reasons: within one sampling time the plant
changes the field hardly more than the noise does, and at wavenumbers without signal the noise of a
state, which is absent from the next one, looks like fast decay. Therefore

1. the terms of the equation are integrated along filtered states: at every wavenumber k a share g of
   the innovation, measured minus predicted, corrects the prediction,

       F[zhat_{k+1}] = F[f(zhat_k, a_k)] + g F[z_{k+1} - f(zhat_k, a_k)].

   With white noise of the power R the innovations have the power P + R, P being that of the error of
   the prediction, and g = P/(P + R) minimises the error (the steady-state Kalman filter of independent
   wavenumbers). So g is 1 while the model is poor and falls as it improves. Once the equation is nearly
   right the error of the states is a small part of the noise, and hardly biases the coefficients;
2. the equation is compared with the measured states over windows of m sampling times with unknown
   initial state x,

       F[z_j] = e^{j L} x + sum_p sigma_p W_p(j) + sum_{i < j} e^{(j - 1 - i) L} phi_1(L) F[B a_i + c],

   j = 0 .. m, where W_p(j) is the integral of e^{L (j - s)} F[z(s)^p] from the beginning of the window;
   x, and then B and c, are projected out at every wavenumber;
3. only wavenumbers with clearly more power than the noise are compared;
4. insignificant coefficients are removed one by one: their influence would be largest at wavenumbers
   that are not measured, where the equation could grow without bound.

Windows become longer as the equation improves; the equation with the smallest innovations is
selected.

References
----------
Messenger, Bortz, "Weak SINDy for partial differential equations", J. Comput. Phys. 443, 2021. Ljung,
"System Identification", 2nd ed., chapters 7 and 16. James, Stein, "Estimation with quadratic loss",
1961 (the entries of B). Anderson, Moore, "Optimal Filtering", chapters 4 and 9 (the filter).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # whose transforms, a tenth of a start, load when they are used
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import FieldModel, Measured, least_squares
from pdeloop.method.models.noise_level import signal_power
from pdeloop.method.models.prediction import finite
from pdeloop.method.models.settings import (
    COEFFICIENT_RIDGE,
    FAR,
    LEAST_CORRECTION,
    FieldModelSettings,
)
from pdeloop.method.models.spectral import SpectralModel, Spectrum
from pdeloop.method.models.spectral_fit import (
    Form,
    Regression,
    fewer_of,
    nothing,
    solved,
    substeps_of,
)
from pdeloop.solver.polynomial_step import phi_functions


@dataclass(frozen=True, eq=False)
class Filtered:
    """States of rollouts, (L + 1, n_z) each, and the model's predictions of them.

    innovations: measured minus predicted states, (L, n_z) each; power: their mean at each wavenumber,
    of Fourier transforms over the number of points; lost: predictions that were not finite, in whose
    place the last state stood.
    """

    states: list[Array]
    innovations: list[Array]
    power: Array
    lost: int


def filtered(
    model: FieldModel,
    rollouts: Sequence[Measured],
    first: Sequence[Array],
    shares: Array,
    *,
    settling: bool = False,
) -> Filtered:
    """The states of rollouts, each with one state more than actions.

    first: their initial states; shares: g, of each wavenumber; settling: at the beginning no less than
    that of an unknown state that rests, 1/(k + 2). A prediction far beyond the measured states is
    rejected.
    """
    n_z, z = model.n_z, np.array(first)
    found = [np.empty(rollout.states.shape) for rollout in rollouts]
    innovations = [np.empty(own[1:].shape) for own in found]
    for own, state in zip(found, z, strict=True):
        own[0] = state
    lengths = np.array([len(rollout.actions) for rollout in rollouts])
    total, count, lost = np.zeros(len(shares)), 0, 0
    most = FAR * max(float(np.abs(rollout.states).max()) for rollout in rollouts)
    for k in range(int(lengths.max())):
        rows = np.flatnonzero(lengths > k).tolist()
        actions = np.stack([rollouts[i].actions[k] for i in rows])
        with np.errstate(all="ignore"):
            predicted = model.step(z[rows], actions)
            wrong = ~(np.abs(predicted).max(axis=1) <= most)
        predicted[wrong] = z[rows][wrong]
        left = np.stack([rollouts[i].states[k + 1] for i in rows]) - predicted
        innovation = scipy.fft.rfft(left) / n_z
        own_shares = np.maximum(shares, 1.0 / (k + 2)) if settling else shares
        z[rows] = predicted + n_z * scipy.fft.irfft(own_shares * innovation, n_z)
        for i, own in zip(rows, left, strict=True):
            found[i][k + 1], innovations[i][k] = z[i], own
        total += np.sum(np.abs(innovation) ** 2, axis=0)
        count, lost = count + len(rows), lost + int(wrong.sum())
    return Filtered(found, innovations, total / count, lost)


_NOISY_STEPS = 2000
"""Maximum number of data steps in a fit with measurement noise."""
_NOISY_POWER = 3.0
"""Mean power of a wavenumber, relative to the noise, from which it is compared."""
_FEWEST_MODES = 4
"""Wavenumbers that are always compared, whatever their power."""
_LARGEST_WINDOW = 16
"""Maximum number of sampling times in a window."""
_GROWTH = 1.5
"""Largest growth of the linear part within a window, as an exponent of e."""
_RELATIVE_ERROR = 0.02
"""Model error of a window as a share of the change within it."""
_SIGNIFICANCE = 3.0
"""Multiple of its standard error that a coefficient must reach to be kept."""

PASSES = ((1, 8), (2, 8), (4, 4), (8, 4), (8, 4), (16, 4), (16, 4))
"""Of each pass, the sampling times of a window, and n: the lowest 1/n wavenumbers are compared."""
STRICTNESS = (1.0, 3.0, 9.0, 27.0)
"""Times the significance of a pass, the next where its equation grows beyond all bounds."""


@dataclass(frozen=True, eq=False)
class WindowRegression(Regression):
    """The regression of a pass over windows; y and W of the wavenumbers that are compared alone.

    common (modes, N, n_a + 1) and free_of_common, its orthonormal columns, are of each wavenumber;
    lost: numbers of each wavenumber that the initial states of the windows take; strictness: multiple
    of the significance that a coefficient must have.
    """

    common: Spectrum
    free_of_common: Spectrum
    lost: int = 0
    strictness: float = 1.0

    def rest(self, values: Spectrum) -> Spectrum:
        q = self.free_of_common[: values.shape[1]]
        columns = values.T[..., None]
        projected: Spectrum = (columns - q @ (np.conj(q.transpose(0, 2, 1)) @ columns))[..., 0].T
        return projected

    def coefficients(self, columns: Spectrum, values: Spectrum) -> Array:
        count = len(self.y) - self.lost - self.common.shape[2]  # complex numbers a wavenumber
        return significant(columns, values, max(count / len(self.y), 0.1), self.strictness)

    def inputs(self, left: Spectrum) -> Spectrum:
        """F of B and c, (n_a + 1, modes), from what the other terms leave (N, modes).

        A wavenumber of B whose size is no larger than the error of its entries is 0.
        """
        found = np.empty((self.common.shape[2], left.shape[1]), complex)
        for k, columns in enumerate(self.common):
            found[:, k] = least_squares(columns, left[:, k : k + 1])[:, 0]
            rest = left[:, k] - columns @ found[:, k]
            free = max(len(left) - self.lost - columns.shape[1], 1)
            inverse = np.linalg.pinv(columns.conj().T @ columns, hermitian=True)
            variance = float(np.sum(np.abs(rest) ** 2)) / free
            error = variance * float(np.trace(inverse[:-1, :-1]).real)
            size = float(np.sum(np.abs(found[:-1, k]) ** 2))
            found[:-1, k] *= max(0.0, 1.0 - error / size) if size > 0.0 else 0.0
        return found


def significant(
    columns: Spectrum,
    values: Spectrum,
    free: float,
    strictness: float = 1.0,
) -> Array:
    """Real coefficients of complex columns, 0 where they are within a few standard errors of it.

    free: share of the values that nothing else was fitted to; strictness: multiple of the significance.
    """
    scale = np.sqrt(np.sum(np.abs(columns) ** 2, axis=0))
    scale = np.where(scale > 0.0, scale, 1.0)
    columns = columns / scale
    gram = (columns.conj().T @ columns).real + COEFFICIENT_RIDGE * np.eye(len(scale))
    moment, total = (columns.conj().T @ values).real, float(np.sum(np.abs(values) ** 2))
    kept = list(range(len(scale)))
    while kept:
        inverse = np.linalg.inv(gram[np.ix_(kept, kept)])
        own = inverse @ moment[kept]
        rest = max(total - float(own @ moment[kept]), 0.0)
        error = np.sqrt(rest / (2.0 * free * len(values)) * np.diag(inverse))
        size = np.abs(own) - strictness * _SIGNIFICANCE * error
        if size.min() >= 0.0:
            break
        kept.pop(int(np.argmin(np.abs(own) / np.where(error > 0.0, error, 1.0))))
    found = np.zeros(len(scale))
    if kept:
        found[kept] = own
    coefficients: Array = found / scale
    return coefficients


def fit_noisy(
    rollouts: Sequence[Measured], form: Form, settings: FieldModelSettings, noise: float
) -> SpectralModel | None:
    """The equation of that form, all of whose symbols are polynomials; None where none is finite.

    rollouts: with `clean`, the initial state of which is where the filter begins; noise: standard
    deviation of the noise on every number of their states.
    """
    rollouts = [short for r in rollouts if len((short := finite(r)).actions)]
    rollouts = _thinned(rollouts)
    n_z, n_a = rollouts[0].states.shape[1], rollouts[0].actions.shape[1]
    first = [rollout.known[0] for rollout in rollouts]
    largest = max(float(np.abs(rollout.states).max()) for rollout in rollouts)
    noise_power = noise**2 / n_z
    cut, shares = _wavenumbers(rollouts, noise)
    model = nothing(form, n_z, n_a, largest)
    best, least = None, np.inf
    known = filtered(model, rollouts, first, shares)
    for window, share in PASSES:
        steps = min(window, _LARGEST_WINDOW)
        growth = max(float(model.linear.real[:cut].max()), 0.0)
        if growth * steps > _GROWTH:
            steps = max(int(_GROWTH / growth), 1)
        data = _regression(model, rollouts, known, steps, cut, noise)
        if data is None:
            break
        compared = replace(form, shares=(max(share, form.shares[-1]),))
        for strictness in STRICTNESS:
            strict = replace(data, strictness=strictness)
            found = solved(strict, model, compared, 0)
            if found is None:
                continue
            found = replace(found, substeps=substeps_of(found.symbols, largest, settings))
            known = filtered(found, rollouts, first, shares)
            if not known.lost:
                break
        if found is None:
            break
        model, error = found, np.maximum(known.power - noise_power, 0.0)
        miss = float(error[:cut].sum()) if not known.lost else np.inf
        if best is None or miss < least:
            best, least = model, miss
        shares = np.clip(error / (error + noise_power), LEAST_CORRECTION, 1.0)
        shares[cut:] = np.minimum(shares[cut:], LEAST_CORRECTION)
    if best is None:
        return None
    return replace(best, fewer=fewer_of(best.symbols, largest, best.substeps, settings))


def _thinned(rollouts: Sequence[Measured]) -> list[Measured]:
    """Rollouts at equal distances, the first among them: few steps, but at least two of them."""
    steps = sum(len(rollout.actions) for rollout in rollouts)
    count = min(len(rollouts), max(2, len(rollouts) * _NOISY_STEPS // max(steps, 1)))
    chosen = np.linspace(0, len(rollouts) - 1, count).round().astype(int)
    return [rollouts[i] for i in np.unique(chosen).tolist()]


def _wavenumbers(rollouts: Sequence[Measured], noise: float) -> tuple[int, Array]:
    """How many of the lowest wavenumbers stand out of the noise, and g of the first pass."""
    n_z = rollouts[0].states.shape[1]
    spectra = [scipy.fft.rfft(rollout.states) for rollout in rollouts]
    signal, noise_power = signal_power(np.concatenate(spectra), noise, n_z)
    weak = signal + noise_power < _NOISY_POWER * noise_power
    cut = max(int(np.argmax(weak)) if weak.any() else len(weak), _FEWEST_MODES)
    steps = np.concatenate([np.diff(own, axis=0) for own in spectra])
    change = np.maximum(np.mean(np.abs(steps) ** 2, axis=0) - 2.0 * noise_power, 0.0)
    shares = change / (change + noise_power)
    shares[cut:] = 0.0
    return min(cut, len(weak)), shares


def _regression(
    model: SpectralModel,
    rollouts: Sequence[Measured],
    known: Filtered,
    steps: int,
    cut: int,
    noise: float,
) -> WindowRegression | None:
    """What is known in windows of so many steps; None where the equation overflows in most."""
    even = replace(model, substeps=model.substeps + model.substeps % 2)
    before = np.concatenate([states[:-1] for states in known.states])
    after = np.concatenate([states[1:] for states in known.states])
    actions = np.concatenate([rollout.actions for rollout in rollouts])
    with np.errstate(all="ignore"):
        try:
            W = even.compiled.integrals(before, actions, after)[0][..., :cut]
        except ValueError:  # it grows beyond all bounds within a substep
            return None
        phi = phi_functions(model.linear)[0][:cut].astype(complex)
        decay = np.exp(model.linear[:cut])
    # Each window has `steps` of the steps and the state at its end besides, whose number is one higher
    # among the states than among the steps for every rollout before.
    windows, own = [], []
    for i, rollout in enumerate(rollouts):
        begin = sum(len(other.actions) for other in rollouts[:i])
        length = min(steps, len(rollout.actions))
        for at in range(0, len(rollout.actions) - length + 1, length):
            if length == steps:
                windows.append(begin + at)
                own.append(begin + i + at)
    if not windows:
        return None
    index = np.array(windows)[:, None] + np.arange(steps)
    W, inputs = W[:, index], np.concatenate([actions, np.ones((len(actions), 1))], axis=1)[index]
    spectra = np.concatenate([scipy.fft.rfft(r.states)[:, :cut] for r in rollouts]) / model.n_z
    y = spectra[np.array(own)[:, None] + np.arange(steps + 1)]
    total = np.zeros((len(W), len(y), steps + 1, cut), complex)
    common = np.zeros((len(y), steps + 1, cut, inputs.shape[2]), complex)
    for j in range(steps):
        total[:, :, j + 1] = decay * total[:, :, j] + W[:, :, j]
        common[:, j + 1] = decay[:, None] * common[:, j] + phi[:, None] * inputs[:, j, None]
    ok = np.asarray(np.isfinite(total).all(axis=(0, 2, 3)))
    ok = ok & np.isfinite(common).all(axis=(1, 2, 3))
    if 2 * ok.sum() < len(y):
        return None
    change = np.sum(np.abs(y[:, -1] - y[:, 0]) ** 2, axis=1)
    variance = 2.0 * noise**2 / model.n_z * cut + _RELATIVE_ERROR**2 * change
    root = 1.0 / np.sqrt(variance[ok])
    # Without the part of each window that its unknown initial state explains.
    free = decay ** np.arange(steps + 1)[:, None]
    free = free / np.linalg.norm(free, axis=0)
    y, total, common = y[ok], total[:, ok], common[ok]
    y = y - free * np.einsum("jk,njk->nk", free.conj(), y)[:, None]
    total = total - free * np.einsum("jk,pnjk->pnk", free.conj(), total)[:, :, None]
    explained = np.einsum("jk,njka->nka", free.conj(), common)
    common = common - free[..., None] * explained[:, None]
    y, total, common = (
        y * root[:, None, None],
        total * root[:, None, None],
        common * root[:, None, None, None],
    )
    columns = common.transpose(2, 0, 1, 3).reshape(cut, -1, inputs.shape[2])
    return WindowRegression(
        symbols=model.symbols,
        y=y.reshape(-1, cut),
        W=total.reshape(len(W), -1, cut),
        phi=phi,
        common=columns,
        free_of_common=_orthonormal(columns),
        miss=0.0,
        lost=int(ok.sum()),
    )


def _orthonormal(columns: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Orthonormal columns of the space of those of each wavenumber; zeros where some are dependent."""
    scale = np.linalg.norm(columns, axis=1, keepdims=True)
    left, values, _ = np.linalg.svd(
        columns / np.where(scale > 0.0, scale, 1.0), full_matrices=False
    )
    return left * (values > 1e-10 * values[:, :1])[:, None]
