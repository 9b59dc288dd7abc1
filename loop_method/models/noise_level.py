# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The measurement noise that states show, where nobody has declared any.

White noise is the same at all wavenumbers and independent from one state to the next. The field of a
plant is neither: its power falls with the wavenumber, and it changes little between states. So in the
shortest waves, with X_k their coefficients at step k,

    P_d = mean |D^d X_k|^2 / binom(2 d, d),        D: difference of successive states,

is sigma^2 for every order d of the difference if they are noise, and differs between orders if they are
the field. Noise is found if P_0, P_1 and P_2 agree, and P_2 of the shortest waves with that of the next
ones. A field that is forced anew at every step may pass the first test, but its spectrum is not flat.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.arrays import Array

ALIKE = 1.2
"""Largest ratio of powers that count as equal."""
LEAST = 1e-3
"""Smallest noise, relative to the root mean square of the states; below, it changes no fit."""
FEWEST = 500
"""Coefficients below which the powers are too uncertain."""


def noise_level(trajectories: Sequence[Array]) -> float:
    """The standard deviation of white noise on states (L, n_z) of fields; 0 where none is seen."""
    usable = [states for states in trajectories if len(states) > 2 and np.isfinite(states).all()]
    if not usable:
        return 0.0
    n = usable[0].shape[1]
    middle, next_ones, shortest = n // 4, slice(n // 4, 3 * n // 8), slice(3 * n // 8, n // 2)
    spectra = [np.fft.rfft(states, axis=1, norm="ortho") for states in usable]
    if middle < 4 or sum(spectrum[:, shortest].size for spectrum in spectra) < FEWEST:
        return 0.0
    powers = [_power(spectra, shortest, order) for order in range(3)]
    powers.append(_power(spectra, next_ones, 2))
    largest = np.sqrt(np.mean([np.mean(states**2) for states in usable]))
    sigma = float(np.sqrt(powers[2]))
    alike = max(powers) <= ALIKE * min(powers)
    return sigma if alike and sigma > LEAST * largest else 0.0


def _power(spectra: Sequence[NDArray[np.complex128]], band: slice, order: int) -> float:
    """P_d of a band of wavenumbers, d: order."""
    found = [np.abs(np.diff(spectrum[:, band], order, axis=0)) ** 2 for spectrum in spectra]
    return float(np.concatenate([own.ravel() for own in found]).mean()) / comb(2 * order, order)
