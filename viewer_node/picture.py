# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The field of one environment as a picture: over space and time, or on two axes as it is now. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.messages.colour_scale import colours
from pdeloop.messages.grid import Grid

UNSEEN = (128, 128, 128)
"""Colour of steps that were not seen."""
Range: TypeAlias = tuple[float, float]
"""Lowest and highest value of the colours; see `pdeloop.messages.colour_scale.field_range`."""


def diverging(fields: NDArray[np.floating], limits: Range) -> NDArray[np.uint8]:
    """Colours (..., 3) of numbers (...), in which NaN stands for what was not seen."""
    low, high = limits
    seen = np.isfinite(fields)
    picture = colours((np.where(seen, fields, low) - low) / (high - low))
    picture[~seen] = UNSEEN
    return picture


def space_time(
    fields: NDArray[np.floating], parts: Sequence[slice], ranges: Sequence[Range]
) -> NDArray[np.uint8]:
    """Fields (steps, points) of components side by side, one row a step."""
    shown = [diverging(fields[:, part], own) for part, own in zip(parts, ranges, strict=True)]
    return np.concatenate(shown, axis=1)


def plane(grid: Grid, state: Array, ranges: Sequence[Range]) -> NDArray[np.uint8]:
    """The components of a state on two axes or more, one below the other, as many as have a range.

    The last axis to the right, the one before upwards; of others the middle.
    """
    shown = [
        diverging(middle(values), limits)[::-1]
        for values, limits in zip(grid.fields(state), ranges, strict=False)
    ]
    return np.concatenate(shown)


def middle(values: Array) -> Array:
    """A component on its last two axes; of others the middle."""
    while values.ndim > 2:
        values = values[len(values) // 2]
    return values
