# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The field of one environment over space and time as a picture. Pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.arrays import Array
from loop_interfaces.grid import Grid

UNSEEN = (128, 128, 128)
"""Colour of steps that were not seen."""
_NEGATIVE, _ZERO, _POSITIVE = (33, 102, 172), (247, 247, 247), (178, 24, 43)


def _colours() -> NDArray[np.uint8]:
    """511 colours from blue over white to red."""
    up = np.linspace(0.0, 1.0, 256)[:, None]
    positive = (1 - up) * _ZERO + up * np.array(_POSITIVE)
    negative = (1 - up) * _ZERO + up * np.array(_NEGATIVE)
    return np.concatenate([negative[:0:-1], positive]).round().astype(np.uint8)


_COLOURS = _colours()


def plane_of(grid: Grid | None, state: Array) -> NDArray[np.float32] | None:
    """The components of a state on two axes or more as one picture, one below the other.

    The last axis to the right, the one before upwards; of others the middle. None for what has fewer
    axes, or is not of this grid.
    """
    if grid is None or len(grid.axes) < 2 or state.size != grid.size:
        return None
    fields = grid.fields(state)
    while fields.ndim > 3:
        fields = fields[:, fields.shape[1] // 2]
    return np.concatenate([field[::-1] for field in fields]).astype(np.float32)


def diverging(fields: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours (..., 3) of numbers (...): zero is white, the largest magnitude full red or blue.

    NaN stands for what was not seen.
    """
    seen = np.isfinite(fields)
    scale = float(np.abs(fields[seen]).max()) if seen.any() else 0.0
    level = np.where(seen, fields, 0.0) / (scale or 1.0)
    picture = _COLOURS[(255 * level).round().astype(np.int64) + 255]
    picture[~seen] = UNSEEN
    return picture
