# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A state as RViz and Foxglove draw it: lines on one axis, coloured cells on two. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from loop_interfaces.arrays import Array
from loop_interfaces.grid import Grid
from viewer_node.picture import NONE, diverging

MOST_CELLS = 10_000
"""Most cells drawn of a component; on a finer grid every n-th along each axis."""
APART = 1.1
"""Distance of two pictures side by side, relative to their size."""


@dataclass(frozen=True)
class Shape:
    """Points of a marker, in m.

    Attributes
    ----------
    points : (N, 2)
        Of a line, or with `size` the centres of cells.
    pairs : bool
        Whether each two points are a line of their own, as of several components.
    size : (float, float) or None
        Of the cells.
    colours : (N, 3)
        Of the cells, from 0 to 1.
    """

    points: Array
    pairs: bool = False
    size: tuple[float, float] | None = None
    colours: Array = field(default_factory=lambda: NONE)


def shape_of(grid: Grid, state: Array, target: Array = NONE, *, is_target: bool = False) -> Shape:
    """The shape of a state, or of its target beside it, in the colours of the state.

    Parameters
    ----------
    grid
        What the state is on; where the state has another size, as that of sensors, it is taken as
        one component equally spaced over it.
    state, target
        Of all components; the target is empty if it is not known.
    is_target
        Whether the target is drawn and not the state.

    Returns
    -------
    Shape
    """
    if state.size != grid.size:
        length = grid.axes[0].length if len(grid.axes) == 1 else float(state.size)
        x = length / state.size * np.arange(state.size, dtype=np.float64)
        return Shape(np.stack([x, target if is_target else state], axis=1))
    if len(grid.axes) > 1:
        return _cells(grid, state, target, is_target)
    drawn = grid.fields(target if is_target else state)
    lines = [np.stack([grid.line.points, values], axis=1) for values in drawn]
    if len(lines) == 1:
        return Shape(lines[0])
    return Shape(np.concatenate([_pairs(line) for line in lines]), pairs=True)


def _pairs(line: Array) -> Array:
    """The two ends of each piece of a line."""
    return np.stack([line[:-1], line[1:]], axis=1).reshape(-1, 2)


def _cells(grid: Grid, state: Array, target: Array, is_target: bool) -> Shape:
    """The cells of the last two axes, of others the middle; the components one below the other."""
    y, x = grid.axes[-2:]
    step = int(np.ceil(np.sqrt(y.size * x.size / MOST_CELLS)))
    rows, columns = y.points[::step], x.points[::step]
    points, colours = [], []
    for component in range(len(grid.components)):
        part = grid.part(component)
        values = grid.fields(target if is_target else state)[component]
        while values.ndim > 2:
            values = values[len(values) // 2]
        own = target[part] if target.size == state.size else NONE
        painted = diverging(values[::step, ::step], own, state[part]) / 255.0
        Y, X = np.meshgrid(rows, columns, indexing="ij")
        place = X + is_target * APART * x.length, Y - component * APART * y.length
        points.append(np.stack(place, axis=-1).reshape(-1, 2))
        colours.append(painted.reshape(-1, 3))
    size = step * x.spacing, step * y.spacing
    return Shape(np.concatenate(points), size=size, colours=np.concatenate(colours))
