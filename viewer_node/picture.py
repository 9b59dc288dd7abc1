# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The field of one environment as a picture: over space and time, or on two axes as it is now. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.messages.colour_scale import colours
from pdeloop.messages.grid import Grid, middle

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


MOST_CELLS = 4096
"""Most cells drawn of a component; on a finer grid every n-th along each axis."""
APART = 1.1
"""Distance of two pictures side by side, relative to their size."""


@dataclass(frozen=True)
class Shape:
    """Points of a marker, in m.

    points (N, 2): of a line, or with `size` the centres of cells; pairs: whether each two points are a
    line of their own, as of several components; size ((float, float) or None): of the cells; colours
    (N, 3): of the cells, from 0 to 1.
    """

    points: Array
    pairs: bool = False
    size: tuple[float, float] | None = None
    colours: Array = field(default_factory=lambda: np.empty(0))


def shape_of(grid: Grid, state: Array, ranges: Sequence[Range], *, beside: bool = False) -> Shape:
    """The shape of a state, or of its target.

    grid: what the state is on; where the state has another size, as that of sensors, it is taken as one
    component equally spaced over it; state: of all components; ranges: of the colours of each
    component; those without one are left out of a picture; beside: whether cells stand beside those of
    another state.
    """
    if state.size != grid.size:
        length = grid.axes[0].length if len(grid.axes) == 1 else float(state.size)
        x = length / state.size * np.arange(state.size, dtype=np.float64)
        return Shape(np.stack([x, state], axis=1))
    if len(grid.axes) > 1:
        return _cells(grid, state, ranges, beside)
    lines = [np.stack([axis.points, state[own]], axis=1) for _, own, axis in grid.parts]
    if len(lines) == 1:
        return Shape(lines[0])
    # The two ends of each piece.
    pairs = [np.stack([line[:-1], line[1:]], axis=1).reshape(-1, 2) for line in lines]
    return Shape(np.concatenate(pairs), pairs=True)


def _cells(grid: Grid, state: Array, ranges: Sequence[Range], beside: bool) -> Shape:
    """The cells of the last two axes, of others the middle; the components one below the other."""
    y, x = grid.axes[-2:]
    step = int(np.ceil(np.sqrt(y.size * x.size / MOST_CELLS)))
    Y, X = np.meshgrid(y.points[::step], x.points[::step], indexing="ij")
    points, colours = [], []
    for i, (values, limits) in enumerate(zip(grid.fields(state), ranges, strict=False)):
        place = X + beside * APART * x.length, Y - i * APART * y.length
        points.append(np.stack(place, axis=-1).reshape(-1, 2))
        painted = diverging(middle(values)[::step, ::step], limits) / 255.0
        colours.append(painted.reshape(-1, 3))
    size = step * x.spacing, step * y.spacing
    return Shape(np.concatenate(points), size=size, colours=np.concatenate(colours))
