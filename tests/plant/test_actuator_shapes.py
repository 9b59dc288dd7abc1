# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Actuators of a plant: their shapes and places."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pde_sim_node.equations import OWN_EQUATIONS, Burgers, Equation
from tests.support.spectral_plants import FISHER, FISHER_GRID, PROBLEMS, make

GAUSSIAN = """
    def supports(self, x, n_a, width):
        centres = self.length * np.array([0.2, 0.7])
        away = (x[:, None] - centres + self.length / 2) % self.length - self.length / 2
        return np.exp(-0.5 * (away / (width * self.length)) ** 2)
"""


def test_actuators_of_any_shape_at_any_place(tmp_path: Path) -> None:
    """From rest a short step gives dt Phi a."""
    path = tmp_path / "fisher.py"
    path.write_text(FISHER + GAUSSIAN)
    grid = FISHER_GRID | {"n_a": 2, "width": 0.1, "sample_time": 1e-6, "integration_time": 1e-6}
    plant = make(OWN_EQUATIONS.load(f"{path}:Fisher")(), **grid)
    z, _ = plant.evaluate(np.zeros((1, 32)), np.array([[1.0, -2.0]]))
    away = np.abs(np.arange(32)[:, np.newaxis] / 32 - [0.2, 0.7])
    shapes = np.exp(-0.5 * (np.minimum(away, 1 - away) / 0.1) ** 2)
    np.testing.assert_allclose(z[0], 1e-6 * (shapes @ [1.0, -2.0]), rtol=1e-4, atol=1e-12)


TEN = {"n_z": 10, "n_a": 3, "sample_time": 0.01}


def test_indicators_stand_where_their_centres_say() -> None:
    """Two of ten points each; 0.31 is nearest to point 3, 0 is at the end and the beginning."""
    plant = make(Burgers(), **TEN, width=0.2, positions=[0.31, 0.0, 0.85])
    points = [[2, 3], [9, 0], [8, 9]]
    expected = np.zeros((10, 3))
    for j, own in enumerate(points):
        expected[own, j] = 1.0
    assert np.array_equal(plant.supports, expected)
    assert np.array_equal(
        make(Burgers(), **TEN, width=0.2, positions=[0.31, 1.0, 0.85]).supports, expected
    )


def test_gaussians_stand_where_their_centres_say() -> None:
    """Of standard deviation 0.1 around 0.1, point 1 has 1, its neighbours exp(-1/2), and so on."""
    plant = make(Burgers(), **TEN, width=0.1, positions=[0.1, 0.5, 0.55], shape="gaussian")
    at = np.exp(-0.5 * np.arange(6) ** 2)
    np.testing.assert_allclose(plant.supports[:, 0], at[[1, 0, 1, 2, 3, 4, 5, 4, 3, 2]])
    np.testing.assert_allclose(plant.supports[:, 1], np.roll(plant.supports[:, 0], 4))
    between = np.exp(-0.5 * np.array([0.5, 1.5]) ** 2)
    np.testing.assert_allclose(plant.supports[[5, 6, 4, 7], 2], between[[0, 0, 1, 1]])
    spaced = make(Burgers(), **TEN, width=0.1, shape="gaussian")
    np.testing.assert_allclose(spaced.supports[:, 1], np.roll(plant.supports[:, 0], 4))


@PROBLEMS
def test_the_places_of_equally_spaced_actuators_may_be_written_out(
    equation: Equation, grid: dict
) -> None:
    plant = make(equation, **grid)
    n_x = len(plant.x)
    centres = [int((j + 0.5) * (n_x // plant.n_a)) / n_x for j in range(plant.n_a)]
    for placed in ({"positions": centres}, {"shape": "indicator"}):
        assert np.array_equal(make(equation, **grid, **placed).supports, plant.supports)


def test_an_action_forces_the_field_where_its_actuator_was_placed() -> None:
    """From rest a short step gives dt Phi a."""
    plant = make(Burgers(), **TEN | {"sample_time": 1e-6}, width=0.2, positions=[0.3, 0.5, 0.9])
    z, _ = plant.evaluate(np.zeros((1, 10)), np.array([[1.0, -2.0, 3.0]]))
    expected = np.array([0.0, 0.0, 1.0, 1.0, -2.0, -2.0, 0.0, 0.0, 3.0, 3.0])
    np.testing.assert_allclose(z[0], 1e-6 * expected, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"positions": [0.1, 0.2]}, "for each of the n_a = 3 actuators, got 2"),
        ({"positions": [0.1, 0.2, 1.1]}, "from 0 to 1, got [0.1, 0.2, 1.1]"),
        ({"positions": [0.1, 0.2, np.nan]}, "from 0 to 1, got [0.1, 0.2, nan]"),
        ({"shape": "square"}, "must be equation, indicator or gaussian, got 'square'"),
        ({"shape": "gaussian", "width": 0.01}, "at least half a grid spacing, 0.05 at 10"),
    ],
)
def test_actuators_that_cannot_be_placed_are_refused(options: dict, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        make(Burgers(), **{**TEN, "width": 0.2, **options})


def test_actuators_of_an_equations_own_are_not_moved_without_a_shape(tmp_path: Path) -> None:
    path = tmp_path / "fisher.py"
    path.write_text(FISHER + GAUSSIAN)
    own = OWN_EQUATIONS.load(f"{path}:Fisher")()
    grid = FISHER_GRID | {"n_a": 2, "width": 0.1}
    with pytest.raises(ValueError, match="fisher has actuators of its own"):
        make(own, **grid, positions=[0.2, 0.7])
    placed = make(own, **grid, positions=[0.2, 0.7], shape="gaussian")
    np.testing.assert_allclose(placed.supports, make(own, **grid).supports, rtol=1e-12)
