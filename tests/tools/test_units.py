# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The same plant in other units of its inputs and of time: explored alike, with the same result."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest

import pdeloop
from pdeloop.exploration_scale import scaled_exploration
from pdeloop.messages.action_set import ActionSet
from pdeloop.problem_check import check
from tests.support.small import FEW_STEPS


class Room(pdeloop.Dynamics):
    """Three temperatures with losses that are not linear, a heater from 0 on, and a flow."""

    n_z, n_a, horizon, target = 3, 2, 30, 20.0
    divergence_bound = 1e4

    def __init__(self, heat: float = 100.0, flow: float = 1.0, step: float = 1.0) -> None:
        self.sample_time, self._unit = step, np.array([heat, flow])
        self.action_low = 0.0, -np.inf
        self.action_weight = self._unit**2 * np.array([1e-5, 0.1])

    def initial_state(self, rng: np.random.Generator) -> Any:
        return 15.0 + 2.0 * rng.standard_normal(3)

    def step(self, z: Any, a: Any) -> Any:
        heat, flow = a * self._unit
        lost = 0.05 * (z - 10.0) * (1.0 + 0.02 * np.abs(z - 10.0))
        between = np.diff(np.diff(z, prepend=z[0], append=z[-1]))
        heated = np.array([0.01, 0.005, 0.01]) * heat + np.array([0.0, 0.3, 0.0]) * flow
        return z + 0.2 * between - lost + heated


def trained(plant: pdeloop.Dynamics, **how: Any) -> tuple[float, str]:
    """Mean cost of the adapted law, and what was said of the exploration."""
    said = io.StringIO()
    run = pdeloop.train(plant=plant, rollouts=8, progress=said, **FEW_STEPS, **how)
    told = [line for line in said.getvalue().splitlines() if "exploring" in line]
    return float(run.costs["adapted"].mean()), "".join(told)


@pytest.fixture(scope="module")
def usual() -> float:
    cost, told = trained(Room())
    assert not told
    return cost


@pytest.mark.parametrize("units", [(1e-2, 1.0), (1e5, 1e3)])
def test_inputs_in_other_units_end_at_the_same_cost(
    usual: float, units: tuple[float, float]
) -> None:
    found, told = trained(Room(*units))
    assert found == pytest.approx(usual, rel=0.02)
    assert "instead of 0.316, for what its actions do to the state" in told
    assert ("actuator 1 with" in told) == (units[1] != 1.0)


def test_only_inputs_that_are_far_off_are_scaled_to_what_they_do() -> None:
    values = pdeloop.problem(plant=Room()).values
    assert values["exploration_scale"] == [] and values["exploration_variance"] == 0.0
    scales = [
        np.multiply(pdeloop.problem(plant=Room(*units)).values["exploration_scale"], units)
        for units in ((1e-2, 1e4), (1e-3, 1e6), (1e5, 1e-5))
    ]
    np.testing.assert_allclose(scales[1:], scales[:1] * np.ones((2, 1)), rtol=0.2)
    again = pdeloop.problem(plant=Room(1e-2, 1e4)).values
    assert again["exploration_variance"] == max(again["exploration_scale"]) ** 2
    plant = pdeloop.problem(plant=Room(1e-2, 1e4)).plant()
    assert scaled_exploration(plant, again) == {}  # as a run that is continued has them
    given = pdeloop.problem(plant=Room(1e-2, 1e4), exploration_variance=4.0).values
    assert given["exploration_scale"] == [] and given["exploration_variance"] == 4.0


def test_the_check_says_which_input_hardly_moves_the_state() -> None:
    def told(**how: Any) -> str:
        values = pdeloop.problem(plant=Room(1e-2), **how).values
        return next(found.text for found in check(values) if "of actuator 0" in found.text)

    action = (
        "an action of {} of actuator 0 changes the state by {} of its distance from the target: "
    )
    assert told() == action.format("0.316", "4e-05") + "it is explored with 4.21e+03"
    told_of_given = told(exploration_variance=1.0)
    assert told_of_given.startswith(action.format("1", "0.0001"))
    assert told_of_given.endswith("write the input in another unit, or set exploration_scale")


class Sticky(Room):
    """The same with a heater that needs 300 W at least, and a flow that does nothing."""

    def step(self, z: Any, a: Any) -> Any:
        heat = np.maximum(a[0] * self._unit[0] - 300.0, 0.0)
        return super().step(z, np.array([heat, 0.0]) / self._unit)


def test_a_dead_band_is_left_and_an_input_without_effect_is_not_scaled() -> None:
    heat, flow = pdeloop.problem(plant=Sticky()).values["exploration_scale"]
    assert 3.2 < heat < 4.0 and flow == pytest.approx(0.316, rel=1e-2)


def test_given_standard_deviations_are_those_of_the_actions() -> None:
    mixed = ActionSet(
        3, [0.0, -1.0, -np.inf], [np.inf, 1.0, np.inf], exploration_scale=[50.0, 0.2, 3.0]
    )
    default = ActionSet(3, mixed.low, mixed.high)
    draws = np.random.default_rng(6).standard_normal((20_000, 3))
    actions = mixed.explored(np.sqrt(mixed.exploration_variance) * draws)
    np.testing.assert_allclose(actions.std(axis=0), [50.0, 0.2, 3.0], rtol=0.05)
    np.testing.assert_allclose(mixed.exploration_mean, [100.0, 0.0, 0.0])
    np.testing.assert_array_equal(mixed.start, default.start)  # which is the plant's
    assert mixed != default
    with pytest.raises(ValueError, match="exploration_scale must be 3 positive numbers"):
        ActionSet(3, exploration_scale=[1.0, 0.0, 1.0])


def test_the_unit_of_time_does_not_change_an_exploration_with_noise() -> None:
    plants = [Room(step=step) for step in (1.0, 1e-3)]
    found = [pdeloop.problem(plant=plant, measurement_noise=0.2).values for plant in plants]
    assert found[0]["exploration_scale"] == found[1]["exploration_scale"]
    heat, flow = found[0]["exploration_scale"]
    least = np.sqrt(2.0 / 30.0) * 0.2 / 0.045
    assert flow == pytest.approx(least / 0.3, rel=0.01)
    assert heat == pytest.approx(least / (100.0 * np.linalg.norm([0.01, 0.005, 0.01])), rel=0.01)
    explored = [pdeloop.problem(plant=plant, measurement_noise=0.2).explore() for plant in plants]
    np.testing.assert_array_equal(*(states for states, _ in explored))
