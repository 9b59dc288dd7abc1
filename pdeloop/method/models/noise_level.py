# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Measurement noise of states: its level, from differences in time, and states without it.

Of the coefficients X_k of any orthonormal wave at step k,

    P_d = mean |D^d X_k|^2 / binom(2 d, d),        D: difference of successive states,

is sigma^2 for white noise, whatever the order d, and what the field adds to it is never negative. So
the least P_d over bands of short waves and orders is the largest sigma^2 that the states allow, and
sigma^2 itself where a band has no waves of the field.

That alone is no evidence of noise: the short waves of a front that moves over several points between
two states are white in time as well. But they are not white in space, as they gather around the front.
Whether there is noise is then decided by a model (`selection`).

Whether residuals are white in time and space, as noise is, is a portmanteau test (`is_white`). The
residuals of a wrong model are smooth, or gather where the field is steep, so that they or their
squares are correlated with their neighbours, whereas of independent noise each of m sample
correlations rho of N numbers is N(0, 1/N), and Q = N sum rho^2 chi-square with m degrees of freedom
(Box and Pierce; McLeod and Li for the squares). As even the best model errs by a small part of the
noise, correlations with a root sum of squares of up to a tolerance tau are accepted, too:

    sqrt(Q) <= tau sqrt(N) + sqrt(chi-square quantile of m at 1 - level).

With tau = 0 independent noise is rejected at the rate `level`, and with tau > 0 at most at that
rate by the triangle inequality.

References
----------
Box, Pierce, "Distribution of residual autocorrelations", J. Am. Stat. Assoc. 65, 1970. McLeod, Li,
"Diagnostic checking ARMA time series models using squared-residual autocorrelations", J. Time Series
Analysis 4, 1983.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb
from typing import Any

import numpy as np
import scipy  # whose transforms, a tenth of a start, load when they are used
import scipy.linalg
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.prediction import weighing
from pdeloop.method.models.settings import NOISE_MISJUDGED

ORDERS = (1, 2, 3, 4)
BANDS = 4
"""Of the wavenumbers from a quarter of the highest one on."""
ALIKE = 1.5
"""Largest ratio of the powers of a band of noise; that of a random walk is 1.75."""
LEAST = 1e-3
"""Smallest noise, relative to the root mean square of the states; below, it changes no fit."""
LOCAL = 0.3
"""Root sum of squares of the correlations in space with which differences count as white."""
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
    noise: float,
    trajectories: Sequence[Array],
    target: Array,
    weights: Array | None = None,
) -> float:
    """The part of sum |W (z - z_r)|^2 over measured states that noise of this size is.

    Nothing predicts it, so that a model without noise that has a smaller E says that there is none.

    weights: W, as for `prediction.errors`.
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
    short = [short_waves(np.diff(states, axis=0)) for states in trajectories]
    _, in_space, _, squares_in_space = np.split(correlations(short)[0], 4)
    return bool(np.sum(in_space**2) + np.sum(squares_in_space**2) > LOCAL**2)


def short_waves(states: Array) -> Array:
    """The upper half of the wavenumbers of states (L, n), as series of half as many points.

    White noise remains white, of the same variance, and what is near to a point remains so.
    """
    n = states.shape[1]
    spectra = scipy.fft.rfft(states)[:, n // 4 : n // 2 + 1] / np.sqrt(2.0)
    spectra[:, 0] = np.sqrt(2.0) * spectra[:, 0].real  # the mean of the series, which is real
    found: Array = scipy.fft.irfft(spectra, 2 * (spectra.shape[1] - 1))
    return found


LAGS = 4
"""Neighbours in time, and in space, with which residuals are correlated."""


def correlations(residuals: Sequence[Array]) -> tuple[Array, int]:
    """Sample correlations of residuals (L, n) with their neighbours, and N, the count of numbers.

    4 LAGS of them: of the residuals in time and in space, and of their squares in time and in space.
    """
    count = sum(own.size for own in residuals)
    found = []
    for parts in (residuals, [own**2 for own in residuals]):
        mean = sum(float(own.sum()) for own in parts) / count
        centred = [own - mean for own in parts]
        total = max(sum(float(np.sum(own**2)) for own in centred), 1e-300)
        for lag in range(1, LAGS + 1):
            found.append(sum(float(np.sum(own[lag:] * own[:-lag])) for own in centred) / total)
        for lag in range(1, LAGS + 1):
            found.append(sum(float(np.sum(own * np.roll(own, lag, 1))) for own in centred) / total)
    return np.array(found), count


def is_white(residuals: Sequence[Array], level: float, tolerance: float = 0.0) -> bool:
    """True unless residuals (L, n) are correlated beyond the tolerance; False without any.

    level: rate at which independent ones with finite fourth moments are rejected.
    """
    residuals = [own for own in residuals if len(own) > LAGS]
    if not residuals or not all(np.isfinite(own).all() for own in residuals):
        return False
    rho, count = correlations(residuals)
    limit = np.sqrt(scipy.special.chdtri(len(rho), level))
    return bool(np.sqrt(count * np.sum(rho**2)) <= tolerance * np.sqrt(count) + limit)


def denoised(states: Array, noise: float) -> Array:
    """A trajectory with the singular values that it would have without noise, nearest in the mean.

    Measurement noise is white in space and time, while the fields of a trajectory have much in common:
    few singular values are above 1 + sqrt(beta), in units of noise sqrt(n), which are those of the
    noise alone; those that are shrink to sqrt((y^2 - beta - 1)^2 - 4 beta) / y.

    Parameters
    ----------
    states : (T, n_z) array
        n is the larger of T and n_z, beta the smaller over it.
    noise : float
        Standard deviation of the noise on every number.

    References
    ----------
    Gavish, Donoho, "Optimal shrinkage of singular values", IEEE Trans. Inf. Theory 63, 2017.
    """
    if not states.size:
        return states
    left, values, right = scipy.linalg.svd(states, full_matrices=False)
    beta, unit = min(states.shape) / max(states.shape), noise * np.sqrt(max(states.shape))
    y = np.maximum(values / unit, 1.0 + np.sqrt(beta))
    shrunk = unit * np.sqrt(np.maximum((y**2 - beta - 1.0) ** 2 - 4.0 * beta, 0.0)) / y
    clean: Array = (left * shrunk) @ right
    return clean


def smoothed(fields: Array, noise: float, components: int = 1) -> Array:
    """Fields with the amplitude at each wavenumber that is nearest to that without noise in the mean.

    The Wiener filter (S - R)/S, with S the mean power of the fields at a wavenumber and R that of the
    noise. A single state among many of its trajectory, such as an initial field, says more by its
    spectrum than by singular values.

    Parameters
    ----------
    fields : (n, n_z) array
        Of one distribution.
    noise : float
        Standard deviation of the noise on every number.
    components : int
        Number of fields in a state, stored one after the other.
    """
    parts = fields.reshape(len(fields), components, -1)
    spectra = np.fft.rfft(parts)
    signal, noise_power = signal_power(spectra, noise, parts.shape[2])
    kept = signal / (signal + noise_power)
    clean: Array = np.fft.irfft(kept * spectra, parts.shape[2]).reshape(fields.shape)
    return clean


def cleaned_states(
    trajectories: Sequence[Array], noise: float, components: int = 1, *, line: bool = True
) -> list[Array]:
    """States of trajectories `denoised`, the initial ones `smoothed` together where they are on a line.

    Parameters
    ----------
    trajectories : sequence of (T, n_z) arrays
        None of them empty.
    noise, components
        As for `smoothed`.
    line : bool
        Whether the states are fields on one axis.
    """
    clean = [denoised(states, noise) for states in trajectories]
    if line and clean:
        first = smoothed(np.stack([states[0] for states in trajectories]), noise, components)
        for own, state in zip(clean, first, strict=True):
            own[0] = state
    return clean


def signal_power(spectra: NDArray[Any], noise: float, points: int) -> tuple[Array, float]:
    """Mean power of fields without noise at each wavenumber, and that of the noise.

    spectra (n, ..): Fourier transforms of fields of so many points.
    """
    noise_power = noise**2 * points
    power = np.mean(np.abs(spectra) ** 2, axis=0)
    return np.maximum(power - noise_power, 0.0), noise_power
