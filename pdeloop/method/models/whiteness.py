# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A portmanteau test: whether residuals are white in time and space, as measurement noise is.

The residuals of a wrong model are smooth, or gather where the field is steep. So they or their squares
are correlated with their neighbours, whereas those of independent noise are not: each of m sample
correlations rho of N numbers is then N(0, 1/N), and Q = N sum rho^2 is chi-square with m degrees of
freedom (Box and Pierce; McLeod and Li for the squares). As even the best model errs by a small part of
the noise, correlations with a root sum of squares of up to a tolerance tau are accepted, too:

    sqrt(Q) <= tau sqrt(N) + sqrt(chi-square quantile of m at 1 - level).

With tau = 0 independent noise is rejected at the rate `level`, and with tau > 0 at most at that rate
by the triangle inequality.

References
----------
Box, Pierce, "Distribution of residual autocorrelations", J. Am. Stat. Assoc. 65, 1970. McLeod, Li,
"Diagnostic checking ARMA time series models using squared-residual autocorrelations", J. Time Series
Analysis 4, 1983.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy  # whose special functions, a tenth of a start, load when they are used

from pdeloop.messages.arrays import Array

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
