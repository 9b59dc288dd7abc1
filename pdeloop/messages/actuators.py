# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The places of actuators on a periodic axis, as plants and those who model them need them. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pdeloop.messages.arrays import Array


def indicator_centres(points: int, n_a: int) -> list[int]:
    """The grid indices of the centres of n_a indicators, points // n_a apart: controlgym's convention.

    Where n_a does not divide the number of points, they do not fill the domain.

    >>> indicator_centres(8, 2), indicator_centres(10, 3)
    ([2, 6], [1, 4, 7])
    """
    spacing = points // n_a
    return [int((j + 0.5) * spacing) for j in range(n_a)]


def indicators(points: int, n_a: int, width: float) -> list[tuple[int, int]]:
    """The grid indices left <= i < right on which n_a indicators of this width act, in grid points.

    The middle of one is up to a grid spacing away from its centre (`indicator_centres`).

    >>> indicators(8, 2, 2.0), indicators(9, 3, 3.0)
    ([(1, 3), (5, 7)], [(0, 2), (2, 5), (5, 8)])
    """
    half = 0.5 * width
    return [(int(c - half), int(c + half)) for c in indicator_centres(points, n_a)]


def placed_indicators(
    points: int, positions: Sequence[float], width: float
) -> list[tuple[int, int]]:
    """The same around the grid points nearest to given shares of the axis, not yet modulo `points`.

    >>> placed_indicators(10, [0.2, 0.0], 3.0)
    [(0, 3), (-2, 1)]
    """
    half = 0.5 * width
    centres = [math.floor(share * points + 0.5) for share in positions]
    return [(math.floor(c - half), math.floor(c + half)) for c in centres]


def extents(supports: Array) -> tuple[Array, Array]:
    """The centres and widths of actuators on a periodic axis, as shares of it.

    A width is that of the indicator with the same second moment.

    Parameters
    ----------
    supports : (points, n_a)
        How each actuator acts on each point of the axis, the first one at 0.

    Returns
    -------
    (n_a,), (n_a,)
        None where one of them acts nowhere, and so has no place.

    Examples
    --------
    >>> supports = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 2.0], [0.0, 2.0], [0.0, 0.0]])
    >>> [found.round(3).tolist() for found in extents(supports)]
    [[0.167, 0.583], [0.5, 0.333]]
    """
    weights, points = np.abs(supports), np.arange(len(supports)) / len(supports)
    total = weights.sum(axis=0)
    if not (np.isfinite(total) & (total > 0.0)).all():
        return np.zeros(0), np.zeros(0)
    centres = np.angle(np.exp(2j * np.pi * points) @ weights) / (2.0 * np.pi) % 1.0
    distance = (points[:, None] - centres + 0.5) % 1.0 - 0.5
    # Each point stands for an interval around it.
    second = np.sum(weights * distance**2, axis=0) / total + len(points) ** -2.0 / 12.0
    return centres, np.minimum(np.sqrt(12.0 * second), 1.0)
