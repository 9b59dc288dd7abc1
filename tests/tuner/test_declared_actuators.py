# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Methods are told of actuators and sensors where the plant has them."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

import pdeloop
from pdeloop.messages.arrays import Array
from pdeloop.method.adapt import Context, Trajectory
from pdeloop.method.models.sensed import Actuators
from tests.support.sensed import SENSORS
from tuner_node.build import build_training, remarks_on


class Unequal(pdeloop.Dynamics):
    """A plant of one's own that says where its actuators are."""

    n_a, grid = 2, pdeloop.Grid.interval(3.0, 60)
    supports = np.zeros((60, 2))
    supports[50:, 0] = supports[:6, 0] = 2.0
    supports[20:24, 1] = -1.0

    def initial_state(self, rng: np.random.Generator) -> Array:
        return rng.standard_normal(60)

    def step(self, z: Array, a: Array) -> Array:
        return z + self.supports @ a


def _declared(problem: pdeloop.Problem, n_a: int) -> Actuators:
    """The actuators that a method is told of."""
    settings = build_training(problem.values).settings
    zero, explored = np.zeros((SENSORS, 1)), Trajectory(np.zeros((2, SENSORS)), np.zeros((1, n_a)))
    return Context(
        zero,
        zero[:, 0],
        1.0,
        1.0,
        1,
        explored,
        actuator_positions=settings.actuator_positions,
        actuator_widths=settings.actuator_widths,
    ).actuators(n_a)


@pytest.mark.parametrize(
    ("name", "shape", "places"),
    [
        *itertools.product(
            ["burgers", "allen-cahn", "kdv", "fisher"],
            ["indicator", "gaussian"],
            [(), (0.004, 0.22, 0.555)],
        ),
        ("kuramoto-sivashinsky-22", "equation", ()),
        ("", "equation", ()),
    ],
)
def test_actuators_are_declared_as_they_are(
    name: str, shape: str, places: tuple[float, ...]
) -> None:
    """Between two sensors nothing else tells where an actuator ends."""
    given: dict[str, Any] = {"sensors": SENSORS, "actuator_shape": shape}
    given |= {"actuator_positions": list(places), "n_a": len(places)} if places else {}
    problem = pdeloop.problem(name, **given) if name else pdeloop.problem(plant=Unequal(), **given)
    supports = np.abs(problem.plant().supports)
    n, n_a = supports.shape
    # An indicator is exactly where the grid has it, and each of its points stands for an interval.
    near = 1e-9 if shape == "indicator" else 1.2 / n
    declared = _declared(problem, n_a)
    moments = np.exp(2j * np.pi * np.arange(n) / n) @ supports
    centres = np.angle(moments) / (2 * np.pi) % 1.0
    distance = (np.arange(n)[:, None] / n - centres + 0.5) % 1.0 - 0.5
    second = np.sum(supports * distance**2, axis=0) / supports.sum(axis=0) + n**-2.0 / 12.0
    off = (declared.centres - centres + 0.5) % 1.0 - 0.5
    np.testing.assert_allclose(off, 0.0, atol=near)
    np.testing.assert_allclose(declared.widths, np.sqrt(12.0 * second), atol=near)


def test_actuators_that_a_plant_does_not_place_on_the_ring_are_declared_as_nothing() -> None:
    """Neither one that acts nowhere nor those between walls have a place on a ring."""

    class Idle(Unequal):
        supports = np.zeros((60, 2))

    class Walled(Unequal):
        grid = pdeloop.Grid(pdeloop.Axis("x", 3.0, 60, periodic=False))

    class Silent(Unequal):
        supports = None

    for kind in (Idle, Walled, Silent):
        declared = _declared(pdeloop.problem(plant=kind(), sensors=SENSORS), 2)
        np.testing.assert_array_equal(declared.centres, [0.25, 0.75])
        assert not declared.declared


def _remarks(plant: type[Unequal], sensors: int) -> list[str]:
    return remarks_on(pdeloop.problem(plant=plant(), sensors=sensors).values)


def test_a_plant_that_does_not_say_where_things_are_is_asked_to_before_a_training() -> None:
    """Else the field between its few sensors is not estimated, or its actuators are misplaced."""

    class Nowhere(Unequal):
        n_z, grid = 60, None

    class Silent(Unequal):
        supports = None

    assert "declares no axis" in "".join(_remarks(Nowhere, SENSORS))
    assert "where its actuators act" in "".join(_remarks(Silent, SENSORS))
    assert not _remarks(Unequal, SENSORS)
    # All of the field is measured.
    assert not _remarks(Nowhere, 0) and not _remarks(Nowhere, 60) and not _remarks(Silent, 0)
    assert not remarks_on(pdeloop.problem("kdv", sensors=SENSORS).values)


def test_a_plant_whose_field_is_never_modelled_between_sensors_is_not_asked() -> None:
    class Nowhere(Unequal):
        n_z, grid = 60, None

    class Pair(Unequal):
        grid = pdeloop.Grid(pdeloop.Axis("x", 3.0, 30), ("u", "v"))
        supports = None

    assert not _remarks(Pair, SENSORS)
    for given in (
        {"optimizer": "two_point", "law": "affine"},
        {"sensor_delays": 2, "law": "affine"},
    ):
        problem = pdeloop.problem(plant=Nowhere(), sensors=SENSORS, **given)
        assert not remarks_on(problem.values)


@pytest.mark.parametrize("sensors", [6, 7, 8])
def test_sensors_are_declared_where_the_plant_reads(sensors: int) -> None:
    """Six sensors of 64 points are not equally spaced."""
    problem = pdeloop.problem("kdv", sensors=sensors, n_z=64)
    settings, plant = build_training(problem.values).settings, problem.plant()
    x = np.arange(64) / 64
    field = np.cos(2.0 * np.pi * x) + np.sin(6.0 * np.pi * x)
    places = np.array(settings.sensor_positions)
    expected = np.cos(2.0 * np.pi * places) + np.sin(6.0 * np.pi * places)
    np.testing.assert_allclose(field[plant.positions], expected, atol=1e-12)
    equal = (np.arange(sensors) + 0.5) / sensors
    assert np.array_equal(places, equal) == (sensors == 8)
