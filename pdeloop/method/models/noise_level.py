# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The level that measurement noise would have, from differences of states in time.

Of the coefficients X_k of any orthonormal wave at step k,

    P_d = mean |D^d X_k|^2 / binom(2 d, d),        D: difference of successive states,

is sigma^2 for white noise, whatever the order d, and what the field adds to it is never negative. So
the least P_d over bands of short waves and orders is the largest sigma^2 that the states allow, and
sigma^2 itself where a band has no waves of the field.

That alone is no evidence of noise: the short waves of a front that moves over several points between
two states are white in time as well. But they are not white in space, as they gather around the front
(`whiteness`). Whether there is noise is then decided by a model (`undeclared_noise`).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np
import scipy  # whose transforms, a tenth of a start, load when they are used

from pdeloop.messages.arrays import Array
from pdeloop.method.models.prediction import weighing
from pdeloop.method.models.settings import NOISE_MISJUDGED
from pdeloop.method.models.whiteness import correlations

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
