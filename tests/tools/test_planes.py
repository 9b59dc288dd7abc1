# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Fields on two axes as pictures, in figures and for ROS tools."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

import pdeloop
from pde_sim_node.plants.loading import as_plant
from pdeloop.environments.signals import told
from pdeloop.frames import Frames
from pdeloop.messages.actuators import Box, boxes_of, parse, text_of
from pdeloop.messages.frames import Frame
from pdeloop.monitor.node import component_names
from pdeloop.report import planes
from pdeloop.report.data import Behaviour
from viewer_node.loop_view import LoopView
from viewer_node.picture import UNSEEN, plane, shape_of, space_time

GRID = pdeloop.Grid(
    (pdeloop.Axis("y", 1.0, 3, periodic=False), pdeloop.Axis("x", 2.0, 4)), ("u", "v")
)
STATE = np.arange(24.0)


class Sheet(pdeloop.Dynamics):
    n_a, horizon, grid = 2, 4, GRID
    supports = np.eye(24, 2)

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(24)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return 0.5 * z


def test_a_component_is_drawn_over_its_axes_with_y_upwards() -> None:
    ax = Figure().subplots()
    picture = planes.plane(ax, GRID, STATE, 1, 0.0, 30.0)
    assert np.array_equal(picture.get_array(), STATE[12:].reshape(3, 4))
    assert picture.get_extent() == [0.0, 2.0, 0.0, 1.0] and picture.origin == "lower"
    assert ax.get_xlabel() == "x (m)"


def test_a_picture_for_ros_has_the_components_one_below_the_other() -> None:
    picture = plane(GRID, STATE, [(-11.0, 11.0), (-23.0, 23.0)])
    assert picture.shape == (6, 4, 3)
    # u is 0 .. 11 upwards, v 12 .. 23; 0 is white.
    assert picture[2, 0].tolist() == [247, 247, 247] and picture[0, 3].tolist() == [103, 0, 31]
    assert picture[3, 3].tolist() == [103, 0, 31]
    assert plane(GRID, STATE, [(0.0, 22.0)])[0, 3].tolist() == [247, 247, 247]


def test_the_range_of_a_field_that_decays_is_that_of_its_episode() -> None:
    """Else what is left of it at the end would have the full colours."""
    view = LoopView(components=GRID.components)
    view.grid = GRID
    for k in range(20):
        view.state(Frame(1, 1, k, 0.1 * k, 0.5**k * STATE[np.newaxis], 3), 0.0)
    low, high = view.colours(0, (0.0, 1.0), 0.0)
    assert high == -low > 2.0
    assert np.abs(plane(GRID, view.current.z, [(low, high)] * 2).astype(int) - 247).max() < 3


def test_a_marker_has_a_cell_at_each_point_with_the_target_beside_the_field() -> None:
    ranges = [(-11.0, 11.0), (-23.0, 23.0)]
    shape = shape_of(GRID, STATE, ranges)
    target = shape_of(GRID, np.zeros(24), ranges, beside=True)
    assert shape.points[:5].tolist() == [[0, 0], [0.5, 0], [1, 0], [1.5, 0], [0, 0.5]]
    assert shape.size == (0.5, 0.5) and len(shape.points) == len(shape.colours) == 24
    assert shape.points[12].tolist() == [0.0, pytest.approx(-1.1)]  # v below u
    np.testing.assert_allclose(target.points - shape.points, [[2.2, 0.0]] * 24)
    assert np.ptp(target.colours, axis=0).tolist() == [0, 0, 0]
    fine = pdeloop.Grid((pdeloop.Axis("y", 1.0, 300), pdeloop.Axis("x", 1.0, 300)))
    assert 2_500 <= len(shape_of(fine, np.zeros(90_000), ranges).points) <= 10_000


def test_a_marker_of_fields_on_one_axis_joins_no_two_components() -> None:
    state = np.array([1.0, 2.0, 3.0, 7.0, 8.0, 9.0])
    one = shape_of(pdeloop.Grid.interval(3.0, 6), state, [])
    assert not one.pairs and one.points[:, 1].tolist() == state.tolist()
    assert one.points[:, 0].tolist() == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]
    walls = pdeloop.Grid.interval(2.0, 3, "uv", periodic=False)
    two = shape_of(walls, state, [])
    assert two.pairs and two.points[:, 1].tolist() == [1, 2, 2, 3, 7, 8, 8, 9]
    assert two.points[:, 0].tolist() == [0, 1, 1, 2] * 2
    sensors = shape_of(walls, state[2:], [])
    assert sensors.points.tolist() == [[0.0, 3.0], [0.5, 7.0], [1.0, 8.0], [1.5, 9.0]]


def test_a_history_for_ros_has_its_own_range_for_each_component() -> None:
    fields = np.array([[0.0, 1.0, 0.0, 100.0], [np.nan] * 4])
    picture = space_time(fields, [slice(0, 2), slice(2, 4)], [(-1.0, 1.0), (-100.0, 100.0)])
    assert np.array_equal(picture[0, 1], picture[0, 3]) and (picture[1] == UNSEEN).all()


def test_an_episode_and_the_check_are_drawn_as_pictures() -> None:
    plant = as_plant(Sheet())
    episode = pdeloop.rollout(plant, lambda k, z: np.ones((2, 2)), [0, 1])
    drawn = [
        [image.get_array() for ax in figure.axes for image in ax.get_images()]
        for figure in (
            pdeloop.plot_episode(plant, episode, 1),
            planes.fields(plant, STATE, episode.states[0, 0]),
        )
    ]
    first, last = drawn[0][0], drawn[0][2]
    assert np.array_equal(first, episode.fields[0, 1, :12].reshape(3, 4))
    assert np.array_equal(last, first / 16)
    assert np.array_equal(drawn[1][0], STATE[:12].reshape(3, 4))
    assert drawn[1][3].sum() == 2.0  # where two actuators act


def test_actuators_act_where_their_supports_are_at_least_half_as_large() -> None:
    supports = np.zeros((24, 3))
    supports[[0, 3], 0] = 1.0  # around the ring in x, at the wall in y
    supports[[17, 18, 21, 22], 1] = 2.0, 1.0, 1.1, 0.9
    wrapped, inner = boxes_of(GRID, supports)
    assert wrapped == Box(0, ((-0.25, 0.25), (-0.75, 0.25)))
    assert inner == Box(1, ((0.25, 1.25), (0.25, 1.25)))
    assert parse(text_of([wrapped, inner])) == [wrapped, inner]


def test_the_live_page_names_the_components_of_a_grid() -> None:
    assert component_names({"grid": GRID.text, "equation": ""}) == ["u", "v"]
    assert component_names({"grid": "{}", "equation": "wave"}) != ["u", "v"]


class Following(Sheet):
    target = np.outer(np.arange(5.0), np.ones(24))


def test_a_target_that_moves_is_shown_as_it_is_at_each_instant() -> None:
    plant = as_plant(Following())
    states = np.zeros((5, 24))
    shown = [Behaviour("none", states, np.zeros((4, 2)), 1.0, -1)]
    figure = planes.behaviour(SimpleNamespace(plant=plant, behaviours=shown))  # type: ignore[arg-type]
    goals = [ax for ax in figure.axes if ax.get_title() == "target"]
    assert [float(ax.images[0].get_array().mean()) for ax in goals] == 2 * [0.0, 1.0, 4.0]
    frames = Frames(plant, fields=states[None])
    for k in (0, 3):
        frames.draw(states[None, k], np.zeros((1, 2)), k)
        pictures = [picture.get_array().mean() for picture in frames._pictures]
        assert pictures == [k, k]
    plant.reset([0, 1])
    assert not told(plant, np.zeros(2))["target"].any()
    plant.step(np.zeros((2, 2)))
    info, error = told(plant, np.zeros(2)), plant.states - 1.0
    assert (info["target"] == 1.0).all()
    np.testing.assert_allclose(info["distance"], np.sqrt(np.mean(error**2, axis=1)))
