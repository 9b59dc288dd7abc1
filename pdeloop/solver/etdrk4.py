# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Coefficients of ETDRK4, exponential time differencing with a fourth-order Runge-Kutta rule.

For du/dt = L u + N(u) with a diagonal L, one step of length dt is

    a  = E2 u + Q N(u)
    b  = E2 u + Q N(a)
    c  = E2 a + Q (2 N(b) - N(u))
    u' = E u + f1 N(u) + 2 f2 (N(a) + N(b)) + f3 N(c)

which is exact for N = 0. With y = dt L the coefficients are E = exp(y), E2 = exp(y/2) and, times dt,

    Q  = (exp(y/2) - 1) / y
    f1 = (-4 - y + exp(y) (4 - 3 y + y^2)) / y^3
    f2 = (2 + y + exp(y) (y - 2)) / y^3
    f3 = (-4 - 3 y - y^2 + exp(y) (4 - y)) / y^3.

Source: Cox & Matthews, J. Comput. Phys. 176 (2002); Kassam & Trefethen, SIAM J. Sci. Comput. 26
(2005), section 2.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Spectrum = NDArray[np.inexact[Any]]

CONTOUR_POINTS = 32


@dataclass(frozen=True)
class Coefficients:
    """The coefficients of one step, each of the shape of L, and real where L is."""

    e: Spectrum
    e2: Spectrum
    q: Spectrum
    f1: Spectrum
    f2: Spectrum
    f3: Spectrum


def etdrk4_coefficients(linear: Spectrum, dt: float) -> Coefficients:
    """The coefficients of steps of length dt for the linear operator L.

    The formulas cancel near y = 0, so each coefficient is taken as its mean over a circle around y,
    where they do not (Cauchy's integral formula). The whole circle is used and the complex mean
    kept: for an imaginary L, half a circle and the real part, as is customary for a real one, would
    be another equation.

    Parameters
    ----------
    linear : (n,) real or complex
        L(k), 1/time.
    dt
        Length of a step, time.

    Raises
    ------
    ValueError
        A coefficient overflows: L has modes that grow by e^700 and more within a step.
    """
    y = dt * np.asarray(linear, dtype=np.complex128)
    angles = 2 * np.pi * (np.arange(CONTOUR_POINTS) + 0.5) / CONTOUR_POINTS
    # Go round 0 or stay short of it, half a unit away at least: on a circle of radius 1, as in the
    # paper, points come close to 0 where |y| is about 1.
    radius = np.where(np.abs(y) < 1, 2.0, 0.5)
    r = y[:, None] + radius[:, None] * np.exp(1j * angles)
    with np.errstate(over="ignore", invalid="ignore"):
        exp, square, cube = np.exp(r), r**2, r**3
        values: tuple[Spectrum, ...] = (
            np.exp(y),
            np.exp(y / 2),
            dt * np.mean((np.exp(r / 2) - 1) / r, axis=1),
            dt * np.mean((-4 - r + exp * (4 - 3 * r + square)) / cube, axis=1),
            dt * np.mean((2 + r + exp * (r - 2)) / cube, axis=1),
            dt * np.mean((-4 - 3 * r - square + exp * (4 - r)) / cube, axis=1),
        )
    if not np.isfinite(values).all():
        raise ValueError(
            "the linear operator must not grow without bound within one integration_time, got a "
            f"growth rate of {np.max(y.real / dt):g} over {dt:g}: take a smaller integration_time"
        )
    if np.isrealobj(linear):
        values = tuple(value.real.copy() for value in values)
    return Coefficients(*values)
