# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Fields on two axes as pictures, in figures and for ROS tools."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

import pdeloop
from pde_sim_node.plants.loading import as_plant
from pdeloop.monitor.node import component_names
from pdeloop.report import planes
from viewer_node.picture import plane_of
from viewer_node.web.page import Page

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
    picture = plane_of(GRID, STATE)
    assert picture is not None and picture.shape == (6, 4)
    assert picture[0].tolist() == [8.0, 9.0, 10.0, 11.0]  # the top row of u
    assert picture[5].tolist() == [12.0, 13.0, 14.0, 15.0]  # the bottom row of v
    assert plane_of(pdeloop.Grid.interval(1.0, 24), STATE) is None
    assert plane_of(GRID, STATE[:5]) is None and plane_of(None, STATE) is None


def test_an_episode_and_the_check_are_drawn_as_pictures() -> None:
    pytest.importorskip("matplotlib")
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


def test_the_live_page_says_grid_point_where_a_row_is_no_place() -> None:
    for grid, length in ((pdeloop.Grid.interval(2.0, 24), 2.0), (GRID, 0.0), (GRID.vector(4), 0.0)):
        page = Page()
        page.take_parameters({"grid": grid.text, "length": 2.0, "horizon": 5})
        assert page.parameters["length"] == length


def test_the_live_page_names_the_components_of_a_grid() -> None:
    assert component_names({"grid": GRID.text, "equation": ""}) == ["u", "v"]
    assert component_names({"grid": "{}", "equation": "wave"}) != ["u", "v"]
