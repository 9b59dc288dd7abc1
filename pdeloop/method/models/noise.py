# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Measurement noise of states: its level, states without it, and equations fitted to it.

Of the coefficients X_k of any orthonormal wave at step k,

    P_d = mean |D^d X_k|^2 / binom(2 d, d),        D: difference of successive states,

is sigma^2 for white noise, whatever the order d, and what the field adds to it is never negative. So
the least P_d over bands of short waves and orders is the largest sigma^2 that the states allow. The
short waves of a front that moves over several points between two states are white in time as well, but
not in space, as they gather around it. A model decides then whether there is noise (`selection`).

In the fit of an equation to noisy rollouts (`fit_noisy`) the regression of `fit_spectral` fails: at
wavenumbers without signal the noise of a state, absent from the next one, looks like fast decay. So

1. the terms of the equation are integrated along filtered states: at every wavenumber k a share g of
   the innovation, measured minus predicted, corrects the prediction,

       F[zhat_{k+1}] = F[f(zhat_k, a_k)] + g F[z_{k+1} - f(zhat_k, a_k)],        g = P/(P + R),

   R being the power of the noise, and P that of the error of the prediction, as the innovations have
   P + R (the steady-state Kalman filter of independent wavenumbers): g falls as the model improves;
2. the equation is compared with the measured states over windows of m sampling times, longer ones as it
   improves, with unknown initial state x,

       F[z_j] = e^{j L} x + sum_p sigma_p W_p(j) + sum_{i < j} e^{(j - 1 - i) L} phi_1(L) F[B a_i + c],

   j = 0 .. m, where W_p(j) is the integral of e^{L (j - s)} F[z(s)^p] from the beginning of the window;
   x, and then B and c, are projected out at every wavenumber with clearly more power than the noise;
3. insignificant coefficients are removed one by one: their influence would be largest at wavenumbers
   that are not measured, where the equation could grow without bound.

References
----------
Messenger, Bortz, "Weak SINDy for partial differential equations", J. Comput. Phys. 443, 2021. Ljung,
"System Identification", 2nd ed., chapters 7 and 16. James, Stein, "Estimation with quadratic loss",
1961 (the entries of B). Anderson, Moore, "Optimal Filtering", chapters 4 and 9 (the filter).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import Any

import numpy as np
import scipy  # whose transforms, a tenth of a start, load when they are used
import scipy.linalg
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import (
    COEFFICIENT_RIDGE,
    FAR,
    FieldModel,
    FieldModelSettings,
    Measured,
    least_squares,
    orthonormal,
    usable,
    weighing,
)
from pdeloop.method.models.spectral import (
    Form,
    Regression,
    SpectralModel,
    Spectrum,
    fewer_of,
    nothing,
    solved,
    substeps_of,
)
from pdeloop.solver.polynomial_step import phi_functions

NOISE_MISJUDGED = 2.0
"""Ratio of the noise in the data to the declared noise, or its inverse, from which they count as
different."""
LEAST_CORRECTION = 0.02
"""Minimum share of an innovation that corrects a filtered state."""
ORDERS = (1, 2, 3, 4)
BANDS = 4
"""Of the wavenumbers from a quarter of the highest one on."""
ALIKE = 1.5
"""Largest ratio of the powers of a band of noise; that of a random walk is 1.75."""
LEAST = 1e-3
"""Smallest noise, relative to the root mean square of the states; below, it changes no fit."""
LOCAL = 0.3
"""Root sum of squares of the correlations in space with which differences count as white."""
LAGS = 4
"""Neighbours with which they are correlated."""
FEWEST = 200
"""Coefficients of a band below which its powers are too uncertain."""


def noise_level(trajectories: Sequence[Array]) -> float:
    """The standard deviation that white noise on states (L, n) would have; 0 if there is none."""
    usable = _usable(trajectories)
    powers = _powers(usable)
    if powers is None:
        return 0.0
    quietest = powers[int(powers.min(axis=1).argmin())]
    alike = quietest.max() <= ALIKE * quietest.min()
    sigma = float(np.sqrt(quietest.min()))
    size = float(np.sqrt(np.mean([np.mean(z**2) for z in usable])))
    return sigma if alike and sigma > LEAST * size and not _is_local(usable) else 0.0


def contradicting_noise(trajectories: Sequence[Array], declared: float) -> float:
    """The noise that states (L, n) seem to have, or at most have; 0 if it contradicts none declared."""
    level = noise_level(trajectories)
    if level > NOISE_MISJUDGED * declared:
        return level
    powers = _powers(_usable(trajectories)) if declared else None
    most = np.inf if powers is None else float(np.sqrt(powers.min()))
    return most if declared > NOISE_MISJUDGED * most else 0.0


def share_of_noise(
    noise: float, trajectories: Sequence[Array], target: Array, weights: Array | None = None
) -> float:
    """The part of sum |W (z - z_r)|^2 over measured states that noise is; weights: W, as for `errors`.

    Nothing predicts it, so that a model without noise that has a smaller E says that there is none.
    """
    seen = weighing(weights)
    own = target.size if weights is None else float(np.sum(weights**2))
    known = [z for z in trajectories if np.isfinite(z).all()]
    size = float(np.mean([np.sum(seen(z - target) ** 2) / len(z) for z in known]))
    return float(noise**2 * own / max(size, 1e-300))


def rows_of(states: Array, shape: Sequence[int]) -> list[Array]:
    """The fields of states (L, n) along the last of several axes, each a trajectory of its own."""
    if len(shape) < 2 or states.shape[1] % shape[-1]:
        return [states]
    return list(np.moveaxis(states.reshape(len(states), -1, shape[-1]), 1, 0))


def _usable(trajectories: Sequence[Array]) -> list[Array]:
    return [z for z in trajectories if len(z) > max(ORDERS) and np.isfinite(z).all()]


def _powers(usable: Sequence[Array]) -> Array | None:
    """P_d in each band and of each order (bands, orders); None where they are too uncertain."""
    if not usable:
        return None
    n = usable[0].shape[1]
    edges = np.unique(np.linspace(n // 8, n // 2, BANDS + 1).astype(int))
    steps = sum(len(z) - max(ORDERS) for z in usable)
    if edges[0] < 1 or steps * int(np.diff(edges).min()) < FEWEST:
        return None
    powers = np.zeros((len(edges) - 1, len(ORDERS)))
    for z in usable:  # one by one, as many states of many numbers take memory
        spectrum = np.fft.rfft(z, axis=1, norm="ortho")
        for i, order in enumerate(ORDERS):
            power = np.sum(np.abs(np.diff(spectrum, order, axis=0)) ** 2, axis=0)
            powers[:, i] += np.add.reduceat(power[: edges[-1]], edges[:-1])
    counts = [sum(len(z) - order for z in usable) * comb(2 * order, order) for order in ORDERS]
    return powers / np.outer(np.diff(edges), counts)


def _is_local(trajectories: Sequence[Array]) -> bool:
    """True if short waves of differences in time, or their squares, are correlated in space."""
    short = np.concatenate([short_waves(np.diff(states, axis=0)) for states in trajectories])
    total = 0.0
    for values in (short - short.mean(), short**2 - np.mean(short**2)):
        shifted = [np.roll(values, lag, axis=1) for lag in range(1, LAGS + 1)]
        rho = [np.sum(values * other) for other in shifted] / max(np.sum(values**2), 1e-300)
        total += float(np.sum(rho**2))
    return total > LOCAL**2


def short_waves(states: Array) -> Array:
    """The upper half of the wavenumbers of states (L, n), as series of half as many points.

    White noise remains white, of the same variance, and what is near to a point remains so.
    """
    n = states.shape[1]
    spectra = scipy.fft.rfft(states)[:, n // 4 : n // 2 + 1] / np.sqrt(2.0)
    spectra[:, 0] = np.sqrt(2.0) * spectra[:, 0].real  # the mean of the series, which is real
    found: Array = scipy.fft.irfft(spectra, 2 * (spectra.shape[1] - 1))
    return found


def denoised(states: Array, noise: float) -> Array:
    """States (T, n_z) with the singular values that they would have without noise, nearest in the mean.

    Measurement noise is white in space and time, while the fields of a trajectory have much in common:
    few singular values y, in units of noise sqrt(n), are above those of the noise alone, 1 +
    sqrt(beta), and shrink to sqrt((y^2 - beta - 1)^2 - 4 beta) / y (Gavish, Donoho, IEEE Trans. Inf.
    Theory 63, 2017). n is the larger of T and n_z, beta the smaller over it.
    """
    if not states.size:
        return states
    left, values, right = scipy.linalg.svd(states, full_matrices=False)
    beta, unit = min(states.shape) / max(states.shape), noise * np.sqrt(max(states.shape))
    y = np.maximum(values / unit, 1.0 + np.sqrt(beta))
    shrunk = unit * np.sqrt(np.maximum((y**2 - beta - 1.0) ** 2 - 4.0 * beta, 0.0)) / y
    clean: Array = (left * shrunk) @ right
    return clean


def smoothed(fields: Array, noise: float) -> Array:
    """Fields (n, n_z) of one distribution without noise of this size, nearest in the mean.

    The Wiener filter (S - R)/S, with S the mean power of the fields at a wavenumber and R that of the
    noise. A single state among many of its trajectory, such as an initial field, says more by its
    spectrum than by singular values.
    """
    spectra, n_z = np.fft.rfft(fields), fields.shape[1]
    signal, noise_power = signal_power(spectra, noise, n_z)
    clean: Array = np.fft.irfft(signal / (signal + noise_power) * spectra, n_z)
    return clean


def cleaned_states(
    trajectories: Sequence[Array], noise: float, *, line: bool = True
) -> list[Array]:
    """States `denoised`, the initial ones `smoothed` together where they are on a line."""
    clean = [denoised(states, noise) for states in trajectories]
    if line and clean:
        first = smoothed(np.stack([states[0] for states in trajectories]), noise)
        for own, state in zip(clean, first, strict=True):
            own[0] = state
    return clean


def signal_power(spectra: NDArray[Any], noise: float, points: int) -> tuple[Array, float]:
    """Mean power at each wavenumber, of spectra (n, ..), without noise, and that of the noise."""
    noise_power = noise**2 * points
    power = np.mean(np.abs(spectra) ** 2, axis=0)
    return np.maximum(power - noise_power, 0.0), noise_power


@dataclass(frozen=True, eq=False)
class Filtered:
    """States of rollouts, (L + 1, n_z) each, and how well the model predicted them.

    power: mean one of measured minus predicted states at each wavenumber; lost: predictions that were
    not finite, in whose place the last state stood.
    """

    states: list[Array]
    power: Array
    lost: int


def filtered(
    model: FieldModel, rollouts: Sequence[Measured], first: Sequence[Array], shares: Array
) -> Filtered:
    """The states of rollouts, each with one state more than actions.

    first: their initial states; shares: g, of each wavenumber. A prediction far beyond the measured
    states is rejected.
    """
    n_z, z = model.n_z, np.array(first)
    found = [np.empty(rollout.states.shape) for rollout in rollouts]
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
        z[rows] = predicted + n_z * scipy.fft.irfft(shares * innovation, n_z)
        for i in rows:
            found[i][k + 1] = z[i]
        total += np.sum(np.abs(innovation) ** 2, axis=0)
        count, lost = count + len(rows), lost + int(wrong.sum())
    return Filtered(found, total / count, lost)


_NOISY_STEPS = 2000
"""Maximum number of data steps in a fit with measurement noise."""
_NOISY_POWER = 3.0
"""Mean power of a wavenumber, relative to the noise, from which it is compared."""
_FEWEST_MODES = 4
"""Wavenumbers that are always compared, whatever their power."""
_GROWTH = 1.5
"""Largest growth of the linear part within a window, as an exponent of e."""
_RELATIVE_ERROR = 0.02
"""Model error of a window as a share of the change within it."""
_SIGNIFICANCE = 3.0
"""Multiple of its standard error that a coefficient must reach to be kept."""

PASSES = ((1, 8), (2, 8), (4, 4), (8, 4), (8, 4), (16, 4), (16, 4))
"""Of each pass, the sampling times of a window, and n: the lowest 1/n wavenumbers are compared."""


@dataclass(frozen=True, eq=False)
class WindowRegression(Regression):
    """The regression of a pass over windows; y and W of the wavenumbers that are compared alone.

    common (modes, N, n_a + 1) and free_of_common are of each wavenumber; lost: numbers of each that the
    initial states take.
    """

    common: Spectrum
    free_of_common: Spectrum
    lost: int = 0

    def rest(self, values: Spectrum) -> Spectrum:
        q = self.free_of_common[: values.shape[1]]
        columns = values.T[..., None]
        projected: Spectrum = (columns - q @ (np.conj(q.transpose(0, 2, 1)) @ columns))[..., 0].T
        return projected

    def coefficients(self, columns: Spectrum, values: Spectrum) -> Array:
        count = len(self.y) - self.lost - self.common.shape[2]  # complex numbers a wavenumber
        return significant(columns, values, max(count / len(self.y), 0.1))

    def inputs(self, left: Spectrum) -> Spectrum:
        """F of B and c (n_a + 1, modes), from (N, modes); 0 where B is no larger than its error."""
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


def significant(columns: Spectrum, values: Spectrum, free: float) -> Array:
    """Real coefficients of complex columns, 0 where they are within a few standard errors of it.

    free: share of the values that nothing else was fitted to.
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
        size = np.abs(own) - _SIGNIFICANCE * error
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

    rollouts: with `clean`, where the filter begins; noise: on every number of their states.
    """
    rollouts = _thinned(usable(rollouts))
    n_z, n_a = rollouts[0].states.shape[1], rollouts[0].actions.shape[1]
    first = [rollout.known[0] for rollout in rollouts]
    largest = max(float(np.abs(rollout.states).max()) for rollout in rollouts)
    noise_power = noise**2 / n_z
    cut, shares = _wavenumbers(rollouts, noise)
    model = nothing(form, n_z, n_a, largest)
    best, least = None, np.inf
    known = filtered(model, rollouts, first, shares)
    for steps, share in PASSES:
        growth = max(float(model.linear.real[:cut].max()), 0.0)
        if growth * steps > _GROWTH:
            steps = max(int(_GROWTH / growth), 1)
        data = _regression(model, rollouts, known, steps, cut, noise)
        if data is None:
            break
        compared = replace(form, shares=(max(share, form.shares[-1]),))
        found = solved(data, model, compared, 0)
        if found is None:
            break
        model = replace(found, substeps=substeps_of(found.symbols, largest, settings))
        known = filtered(model, rollouts, first, shares)
        error = np.maximum(known.power - noise_power, 0.0)
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
    lengths = [len(rollout.actions) for rollout in rollouts]
    counts = [length // steps for length in lengths]
    if not any(counts):
        return None
    begin = np.cumsum([0, *lengths[:-1]])
    windows = np.concatenate(
        [at + steps * np.arange(n) for at, n in zip(begin, counts, strict=True)]
    )
    own = windows + np.repeat(np.arange(len(rollouts)), counts)
    index = windows[:, None] + np.arange(steps)
    W, inputs = W[:, index], np.concatenate([actions, np.ones((len(actions), 1))], axis=1)[index]
    spectra = np.concatenate([scipy.fft.rfft(r.states)[:, :cut] for r in rollouts]) / model.n_z
    y = spectra[own[:, None] + np.arange(steps + 1)]
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
    y, total = (values * root[:, None, None] for values in (y, total))
    columns = common * root[:, None, None, None]
    columns = columns.transpose(2, 0, 1, 3).reshape(cut, -1, inputs.shape[2])
    return WindowRegression(
        symbols=model.symbols,
        y=y.reshape(-1, cut),
        W=total.reshape(len(W), -1, cut),
        phi=phi,
        common=columns,
        free_of_common=orthonormal(columns),
        miss=0.0,
        lost=int(ok.sum()),
    )
