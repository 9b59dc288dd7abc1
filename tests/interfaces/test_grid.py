# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The layout of a state: points, components and equally spaced places on any number of axes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pdeloop.messages.actuators import boxes_of
from pdeloop.messages.grid import Axis, Grid


def test_the_points_of_an_axis_are_on_a_circle_on_walls_or_in_cells() -> None:
    def points(**how: bool) -> list[float]:
        return Axis("x", 2.0, 4, **how).points.tolist()

    assert points() == [0.0, 0.5, 1.0, 1.5]
    assert points(periodic=False) == pytest.approx([0, 2 / 3, 4 / 3, 2])
    assert points(periodic=False, walls=False) == [0.25, 0.75, 1.25, 1.75]


def test_a_state_is_one_component_after_the_other_in_c_order() -> None:
    grid = Grid((Axis("y", 1.0, 3, periodic=False), Axis("x", 2.0, 5)), ("u", "v"))
    assert (grid.shape, grid.points, grid.size, grid.volume) == ((3, 5), 15, 30, 2.0)
    states = np.arange(60.0).reshape(2, 30)
    fields = grid.fields(states)
    assert fields.shape == (2, 2, 3, 5)
    assert fields[1, 1, 2, 4] == states[1, grid.part(1)][2 * 5 + 4]
    assert not grid.is_circle and Grid.interval(1.0, 8).is_circle


def test_a_plain_vector_has_no_axes() -> None:
    grid = Grid.vector(5)
    assert (grid.shape, grid.size, grid.axes, grid.is_circle) == ((5,), 5, (), False)
    assert grid.equally_spaced(2).tolist() == [1, 3]


def test_fields_of_different_lengths_follow_each_other_in_a_vector() -> None:
    grid = Grid(fields={"flow": (3, 5), "height": (0, 3)})
    assert (grid.shape, grid.size, grid.axes, grid.is_circle) == ((5,), 5, (), False)
    z = np.arange(5.0)
    found = {part.name: (z[part.numbers].tolist(), part.axis.size) for part in grid.parts}
    assert found == {"height": ([0.0, 1.0, 2.0], 3), "flow": ([3.0, 4.0], 2)}
    assert list(found) == ["height", "flow"] and grid.part(1) == slice(3, 5)
    assert Grid.parse(grid.text) == grid != Grid.vector(5)
    boxes = boxes_of(grid, np.eye(5)[:, [1, 4]])
    assert [(box.component, box.sides) for box in boxes] == [(0, ((0.5, 1.5),)), (1, ((0.5, 1.5),))]


def test_fields_of_one_length_are_components() -> None:
    fields, axis = {"u": (0, 4), "v": (4, 8)}, Axis("x", 2.0, 4)
    assert Grid(fields=fields) == Grid((), ("u", "v"), numbers=4)
    assert Grid(axis, fields=fields) == Grid(axis, ("u", "v"))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"a": (0, 3), "b": (2, 5)}, "'b' must begin at 3 .* got 2 to 5"),
        ({"a": (0, 3), "b": (4, 5)}, "'b' must begin at 3 .* nor leave a gap, got 4 to 5"),
        ({"a": (1, 3)}, "'a' must begin at 0"),
        ({"a": (0, 0)}, "end after it"),
        ({"a": (0, 2.5)}, "two whole numbers, its first and its end"),
        ({"a": 3}, "two whole numbers"),
        ({}, "at least one field, got none"),
    ],
)
def test_fields_that_are_no_state_are_refused(fields: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Grid(fields=fields)


def test_fields_that_do_not_fit_the_axes_are_refused() -> None:
    with pytest.raises(ValueError, match="fields have 8 numbers, but the axes have 6"):
        Grid(Axis("x", 1.0, 3), fields={"u": (0, 4), "v": (4, 8)})
    with pytest.raises(ValueError, match="different lengths have no axes in common"):
        Grid(Axis("x", 1.0, 3), fields={"u": (0, 3), "v": (3, 5)})
    whole = Grid(fields={"u": (0, 3), "v": (3, 5)}).text
    for wrong in (whole.replace("5", "6"), whole.replace('["u", 3], ["v", 2]', "")):
        with pytest.raises(ValueError, match="does not describe a grid: its fields do not fit"):
            Grid.parse(wrong)


def test_places_on_two_axes_are_as_far_apart_along_both() -> None:
    grid = Grid((Axis("y", 1.0, 20), Axis("x", 4.0, 80)))
    rows, columns = np.unravel_index(grid.equally_spaced(16), grid.shape)
    assert sorted(set(rows.tolist())) == [5, 15]
    assert sorted(set(columns.tolist())) == [5, 15, 25, 35, 45, 55, 65, 75]
    assert grid.equally_spaced(1600).tolist() == list(range(1600))


@pytest.mark.parametrize(
    ("count", "words"),
    [(17, "at most the 16 grid points"), (11, "product of one number per axis, of at most")],
)
def test_places_that_do_not_fit_are_refused(count: int, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Grid((Axis("y", 1.0, 4), Axis("x", 1.0, 4))).equally_spaced(count)


def test_one_axis_or_component_may_be_given_by_itself() -> None:
    axis = Axis("x", 2.0, 5)
    assert Grid(axis, "height") == Grid((axis,), ("height",)) == Grid([axis], ["height"])  # type: ignore[arg-type]


def test_what_is_no_grid_is_refused() -> None:
    with pytest.raises(ValueError, match="the axes of a grid must be of the class Axis, got 3"):
        Grid((3,))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="the axes of a grid must be of the class Axis, got 4"):
        Grid(4)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"as in Axis\('x', 1.0, 12\), got 'x', 5 and 1.0"):
        Axis("x", 5, 1.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least 1 point"):
        Axis("x", 1.0, 0)
    with pytest.raises(ValueError, match="give one of the two"):
        Grid()
    with pytest.raises(ValueError, match="at least one component"):
        Grid.interval(1.0, 4, ())
