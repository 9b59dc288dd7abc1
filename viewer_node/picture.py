# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The field of one environment as a picture: over space and time, or on two axes as it is now. Pure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.arrays import Array
from loop_interfaces.colour_scale import colours, field_range
from loop_interfaces.grid import Grid

UNSEEN = (128, 128, 128)
"""Colour of steps that were not seen."""
NONE: Array = np.empty(0)


def diverging(
    fields: NDArray[np.floating], target: Array = NONE, all_fields: NDArray[np.floating] = NONE
) -> NDArray[np.uint8]:
    """Colours (..., 3) of numbers (...): the target or 0 is white; see `field_range`.

    NaN stands for what was not seen; target: of any shape, empty if it is not known; all_fields: what
    the range of the colours is taken from, if not from `fields`.
    """
    low, high = field_range(all_fields if all_fields.size else fields, target)
    seen = np.isfinite(fields)
    picture = colours((np.where(seen, fields, low) - low) / (high - low))
    picture[~seen] = UNSEEN
    return picture


def space_time(
    fields: NDArray[np.floating], parts: Sequence[slice], target: Array = NONE
) -> NDArray[np.uint8]:
    """Fields (steps, points) of components side by side, one row a step, each with its own range."""
    shown = [diverging(fields[:, part], target[part]) for part in parts]
    return np.concatenate(shown, axis=1)


def plane(grid: Grid, state: Array, target: Array = NONE) -> NDArray[np.uint8]:
    """The components of a state on two axes or more, one below the other, each with its own range.

    The last axis to the right, the one before upwards; of others the middle.
    """
    known = target.size == state.size
    shown = []
    for component in range(len(grid.components)):
        part = grid.part(component)
        values = grid.fields(state)[component]
        while values.ndim > 2:
            values = values[len(values) // 2]
        shown.append(diverging(values, target[part] if known else NONE, state[part])[::-1])
    return np.concatenate(shown)
