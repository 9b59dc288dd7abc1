# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The places of actuators on a periodic axis, as plants and those who model them need them. Pure."""

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


MOST = 256
"""Most actuators that are reported; more could not be told apart in a picture."""


@dataclass(frozen=True)
class Box:
    """The region in which an actuator acts with at least half of its largest magnitude.

    component: the one on which it acts most; sides: along each axis, in m. On a periodic axis the low
    one is negative where the box goes around.
    """

    component: int
    sides: tuple[tuple[float, float], ...]


def boxes_of(grid: Grid, supports: Array) -> list[Box]:
    """The boxes of actuators; one that acts nowhere has none.

    grid: of the state; a plain vector counts as one axis of its numbers; supports (n_z, n_a): how each
    actuator acts on each number of a state.

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

    ValueError if the text does not describe boxes.

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
