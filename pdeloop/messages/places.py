# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Positions of a plant's actuators, as its node announces and pictures show them. Pure."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.messages.documents import parse_json
from pdeloop.messages.grid import Axis, Grid

MOST = 256
"""Most actuators that are reported; more could not be told apart in a picture."""


@dataclass(frozen=True)
class Box:
    """The region in which an actuator acts with at least half of its largest magnitude.

    Attributes
    ----------
    component : int
        The one on which it acts most.
    sides : tuple of (low, high)
        Along each axis, in m. On a periodic axis the low one is negative where the box goes around.
    """

    component: int
    sides: tuple[tuple[float, float], ...]


def boxes_of(grid: Grid, supports: Array) -> list[Box]:
    """The boxes of actuators; one that acts nowhere has none.

    Parameters
    ----------
    grid
        Of the state; a plain vector counts as one axis of its numbers.
    supports : (n_z, n_a)
        How each actuator acts on each number of a state.

    Returns
    -------
    list of Box

    Examples
    --------
    >>> supports = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 2.0], [1.0, 0.0]])
    >>> for box in boxes_of(Grid.interval(4.0, 4), supports):
    ...     print(box.sides)
    ((-1.5, 0.5),)
    ((0.5, 2.5),)
    """
    parts, found = grid.parts, []
    for support in np.abs(supports[:, :MOST]).T:
        largest = float(support.max())
        if not 0.0 < largest < math.inf:
            continue
        at = int(support.argmax())
        component = next(i for i, part in enumerate(parts) if at < part.numbers.stop)
        _, own, line = parts[component]
        axes: tuple[Axis, ...] = (line,)
        field = support[own]
        if len(grid.axes) > 1:
            axes, field = grid.axes, field.reshape(grid.shape)
        inside = field >= 0.5 * largest
        others = [
            tuple(d for d in range(inside.ndim) if d != direction)
            for direction in range(inside.ndim)
        ]
        sides = [_side(a, inside.any(axis=rest)) for a, rest in zip(axes, others, strict=True)]
        found.append(Box(component, tuple(sides)))
    return found


def _side(axis: Axis, inside: NDArray[np.bool_]) -> tuple[float, float]:
    """From the first to the last of these points, with half a spacing around them."""
    at = np.flatnonzero(inside)
    half, points = 0.5 * axis.spacing, axis.points
    gaps = np.diff(at)
    if axis.periodic and gaps.size and gaps.max() > at[0] + axis.size - at[-1]:
        last, first = at[int(gaps.argmax())], at[int(gaps.argmax()) + 1]
        return float(points[first]) - axis.length - half, float(points[last]) + half
    return float(points[at[0]]) - half, float(points[at[-1]]) + half


def text_of(boxes: Sequence[Box]) -> str:
    """The text of a plant's parameter `actuators`."""
    rounded = [
        [box.component, *[[float(f"{end:.5g}") for end in side] for side in box.sides]]
        for box in boxes
    ]
    return json.dumps(rounded)


def parse(text: str) -> list[Box]:
    """The boxes of a parameter.

    Raises
    ------
    ValueError
        The text does not describe boxes.

    Examples
    --------
    >>> parse(text_of([Box(1, ((0.0, 0.5),))]))
    [Box(component=1, sides=((0.0, 0.5),))]
    """
    try:
        boxes = [
            Box(int(component), tuple((float(low), float(high)) for low, high in sides))
            for component, *sides in parse_json(text)[:MOST]
        ]
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise ValueError(f"{text[:200]!a} does not describe actuators: {error}") from error
    ends = [end for box in boxes for side in box.sides for end in side]
    if not all(map(math.isfinite, ends)):
        raise ValueError(f"{text[:200]!a} describes actuators without positions")
    return boxes
