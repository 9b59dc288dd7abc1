# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What is likely of an equation between sensors, and of initial fields, before they are measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.sensed import WAVES
from pdeloop.method.models.sensed_unknowns import COEFFICIENTS, FIRST, SHARED, TERMS, unknowns
from pdeloop.method.models.settings import FieldModelSettings

_RIDGE = 1e-5
"""Ridge of the unknowns of the equation."""
_DEVIATION = 10.0
"""Prior standard deviation of the unknowns of the equation, with measurement noise."""
_FIELD_RIDGE = 1e-3
"""Ridge of the Fourier coefficients of an initial field."""
_FIELD_DEVIATION = 0.5
"""Prior deviation of the Fourier coefficients of a field, relative to the readings, with noise."""
_FIELD_WAVE = 4.0
"""Wavenumber beyond which both grow stricter with its square."""


class SensedPrior:
    """The ridges that a fit adds to its squared errors, one for each unknown.

    rollouts: how many initial fields are fitted; size: that of the readings. The methods take the
    indices of the shared unknowns that are open and the variance of the noise on a residual.
    """

    def __init__(
        self, rollouts: int, actuators: int, size: float, settings: FieldModelSettings
    ) -> None:
        self._rollouts, self._size, self._settings = rollouts, size, settings
        self.place_ridge = 0.0
        """That of the shifts, widths and differences of actuators."""
        self.precision = np.zeros(unknowns(actuators))
        """Further ridges of the shared unknowns, large where one was found not to be significant."""
        self.spread: Array | None = None
        """Standard deviations of the coefficients of a field, (33,), if they are known."""
        self._waves = np.r_[0, 1 : WAVES + 1, 1 : WAVES + 1]

    def forget(self) -> None:
        """Take all unknowns for relevant again."""
        self.precision = np.zeros(len(self.precision))

    @property
    def suggested(self) -> Array:
        """Standard deviations of the coefficients of a field, (33,), from its size alone."""
        falling = 1.0 + (self._waves / _FIELD_WAVE) ** 2
        found: Array = _FIELD_DEVIATION * self._size / falling
        return found

    def ridges(self, opened: NDArray[np.intp], variance: float) -> Array:
        """Those of a fit: of the open shared unknowns and of the fields."""
        shared = len(self.precision)
        found = self.given(opened, variance)
        found[:shared] += self.precision
        found[COEFFICIENTS + 1 : shared] += self.place_ridge**2
        return np.concatenate([found[opened], found[shared:]])

    def given(self, opened: NDArray[np.intp], variance: float) -> Array:
        """Those of all unknowns, whatever a fit found significant and wherever it holds actuators."""
        settings = self._settings
        shared = np.full(len(self.precision), variance / _DEVIATION**2)
        shared[SHARED:] = variance / settings.sensed_unequal**2 + settings.sensed_unequal_ridge**2
        shared += _RIDGE**2
        shared[_loose(opened)] *= 1e-4
        rising = (1.0 + (self._waves / _FIELD_WAVE) ** 2) ** 2 / self._size**2
        field = _FIELD_RIDGE**2 / self._rollouts * rising
        if self.spread is None:
            field += variance / _FIELD_DEVIATION**2 * rising
        else:
            field += variance / self.spread**2
        return np.concatenate([shared, np.tile(field, self._rollouts)])


def _loose(opened: NDArray[np.intp]) -> list[int]:
    """Unknowns that nobody knows the size of."""
    found = [int(i) for i in opened if len(FIRST) <= i < len(TERMS)]
    fourth = TERMS.index((1, 4)) in found
    return [*found, TERMS.index((1, 2))] if fourth else found
