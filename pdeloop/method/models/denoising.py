# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Denoising of measured states, before any model is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array


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
