# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A mean of few numbers, and whether it is below zero by more than chance.

The standard error of a mean of k numbers is an estimate with k - 1 degrees of freedom. The mean is
below zero at the one-sided level alpha if

    mean + t(1 - alpha, k - 1) error < 0,        t: quantile of Student's distribution.

Where errors of several origins add up, the degrees of their sum are those of Welch and Satterthwaite,

    nu = (sum e_i^2)^2 / sum (e_i^4 / nu_i),

so that the error of a control variate, known from many fields, counts as such, and that of three
rollouts as one of three.

References
----------
Welch, "The generalization of Student's problem when several different population variances are
involved", Biometrika 34, 1947; Satterthwaite, Biometrics Bulletin 2, 1946.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdeloop.messages.arrays import Array


@dataclass(frozen=True)
class Estimate:
    """An estimated difference or mean, its standard error, and the degrees of freedom of that."""

    value: float = 0.0
    error: float = 0.0
    degrees: float = 1.0

    def __add__(self, other: Estimate) -> Estimate:
        """The sum of two independent estimates.

        >>> both = Estimate(1.0, 3.0, 4.0) + Estimate(1.0, 4.0, 4.0)
        >>> both.value, round(both.error, 6), round(both.degrees, 2)
        (2.0, 5.0, 7.42)
        """
        value, error = self.value + other.value, float(np.hypot(self.error, other.error))
        known = [own for own in (self, other) if own.error > 0.0]
        if len(known) < 2 or not np.isfinite(error):
            return Estimate(value, error, known[0].degrees if known else 1.0)
        spread = sum((own.error / error) ** 4 / own.degrees for own in known)
        return Estimate(value, error, 1.0 / spread)

    def __sub__(self, other: Estimate) -> Estimate:
        return self + Estimate(-other.value, other.error, other.degrees)

    def is_negative(self, confidence: float, times: float = 1.0) -> bool:
        """True if it is below 0 by `times` as much as chance: `confidence` exact standard errors."""
        return self.value + times * errors_for(confidence, self.degrees) * self.error < 0.0


ZERO = Estimate()
"""Where nothing was measured."""


def errors_for(confidence: float, degrees: float) -> float:
    """How many estimated standard errors are as unlikely as `confidence` exact ones.

    >>> [round(errors_for(1.0, degrees), 2) for degrees in (1.0, 2.0, 5.0, 40.0)]
    [1.84, 1.32, 1.11, 1.01]
    """
    # Not at the top: few processes need it.
    from scipy.special import ndtr, stdtrit

    return float(stdtrit(degrees, ndtr(confidence)))


def mean_of(values: Array) -> Estimate:
    """The mean of some numbers; the error of a single one is as large as itself.

    >>> mean_of(np.array([1.0, 3.0]))
    Estimate(value=2.0, error=1.0, degrees=1.0)
    """
    mean = float(np.mean(values))
    if len(values) < 2:
        return Estimate(mean, abs(mean), 1.0)
    error = float(np.std(values, ddof=1) / np.sqrt(len(values)))
    return Estimate(mean, error, len(values) - 1.0)


def mean_change(costs: Array, before: Array) -> Estimate:
    """The mean change of the costs; the error is that of the ratio of means, times the mean before.

    >>> mean_change(np.array([1.0, 2.0]), np.array([2.0, 4.0]))
    Estimate(value=-1.5, error=0.0, degrees=1.0)
    """
    change = mean_of(costs - before)
    if len(costs) < 2 or not before.any():
        return change
    ratio = float(costs.mean() / before.mean())
    return Estimate(change.value, mean_of(costs - ratio * before).error, change.degrees)
