# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The colours of a field, the same in every picture: blue below the target or 0, red above it. Pure.

The scale is diverging, ColorBrewer's RdBu (Harrower, Brewer, The Cartographic Journal 40, 2003), which
any colour vision can read. On a dark background the middle is dark instead of white, so that what is
at its target does not stand out there either. The live page has the same stops
(viewer_node/web/static/scale.js).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LIGHT = (
    "#053061",
    "#2166ac",
    "#4393c3",
    "#92c5de",
    "#d1e5f0",
    "#f7f7f7",
    "#fddbc7",
    "#f4a582",
    "#d6604d",
    "#b2182b",
    "#67001f",
)
"""From far below the middle to far above it, on a light background."""
DARK = (
    "#a6d8ff",
    "#6fb3e8",
    "#3f86c0",
    "#285c88",
    "#1d3a55",
    "#1b1f26",
    "#4a2419",
    "#7d3520",
    "#b85a3a",
    "#e58a66",
    "#ffc9b0",
)
"""The same on a dark one."""
ROBUST = 98.0
"""Percentile of the distances from the middle that the colours span: a shock's tip or a divergence
would leave no contrast to the rest."""


def field_range(values: NDArray[np.floating], target: NDArray[np.floating]) -> tuple[float, float]:
    """The lowest and highest value of the colours, equally far from the middle.

    The middle is the target where that is constant, its mean where it is nowhere 0, and otherwise 0.
    The range holds the whole target and ROBUST % of the values.
    values: of a component, of any shape; values that are not finite are ignored; target: its target, of
    any shape; empty if it is not known.

    Examples
    --------
    >>> field_range(np.array([4.0, 4.0, np.nan]), np.array([2.0, 2.0]))
    (0.0, 4.0)
    >>> field_range(np.zeros(5), np.array([-1.0, 4.0]))
    (-4.0, 4.0)
    >>> field_range(np.array([]), np.array([]))
    (-1.0, 1.0)
    """
    low, high = (float(target.min()), float(target.max())) if target.size else (0.0, 0.0)
    middle = float(target.mean()) if low * high > 0 else 0.0
    seen = values[np.isfinite(values)]
    reach = float(np.percentile(np.abs(seen - middle), ROBUST)) if seen.size else 0.0
    reach = max(reach, high - middle, middle - low)
    if reach < 1e-9 * (abs(middle) or 1.0):
        reach = abs(middle) or 1.0
    return middle - reach, middle + reach


def colours(levels: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Colours on a light background.

    levels (...): from 0, the lowest value, to 1, the highest; beyond that it is cut off. NaN is not
    allowed. Returns (..., 3): red, green, blue.

    Examples
    --------
    >>> colours(np.array([0.0, 0.5, 7.0])).tolist()
    [[5, 48, 97], [247, 247, 247], [103, 0, 31]]
    """
    found: NDArray[np.uint8] = _TABLE[
        np.rint(np.clip(levels, 0.0, 1.0) * (len(_TABLE) - 1)).astype(np.intp)
    ]
    return found


def _table(stops: tuple[str, ...], size: int = 511) -> NDArray[np.uint8]:
    """The stops with as many colours between them as make `size`."""
    given = np.array([[int(stop[i : i + 2], 16) for i in (1, 3, 5)] for stop in stops])
    at = np.linspace(0.0, len(stops) - 1.0, size)
    channels = [np.interp(at, np.arange(len(stops)), channel) for channel in given.T]
    table: NDArray[np.uint8] = np.rint(np.stack(channels, axis=-1)).astype(np.uint8)
    return table


_TABLE = _table(LIGHT)
