# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a plant of a user's own that does not fit is told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import pdeloop
from pde_sim_node.plants import DynamicsPlant
from pdeloop.messages.own_code import OwnCodeError
from tests.support.linear_dynamics import Linear


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [("sampling_time", "sample_time"), ("action_lo", "action_low"), ("mean_states", "mean_state")],
)
def test_a_misspelt_attribute_is_refused_with_the_one_that_was_meant(
    wrong: str, meant: str
) -> None:
    with pytest.raises(ValueError, match=f"Own sets '{wrong}'.*; did you mean '{meant}'"):
        DynamicsPlant(type("Own", (Linear,), {wrong: 3.0})())


@pytest.mark.parametrize("own", ["_sampling_time", "viscosity", "targets"])
def test_an_attribute_of_ones_own_is_left_alone(own: str) -> None:
    """`targets` next to `target`, too, which is set."""
    assert DynamicsPlant(type("Own", (Linear,), {own: 3.0})()).n_a == 2


class Breaking(Linear):
    """Fails as it is told, where the last number of the state is beyond 10."""

    def __init__(self, how: str) -> None:
        super().__init__()
        self.how = how

    def step(self, z: np.ndarray, a: np.ndarray) -> Any:
        match self.how:
            case "nan":
                return np.full(3, np.nan)
            case "overflow":
                return z * 1e308 * 1e308
            case "shape":
                return np.zeros((2, 2))
            case "none":
                return None
            case "complex":
                return z * 1j
            case "changes z":
                z += 1
                return z
            case "changes a":
                a[0] = 0.25
                return z
            case "exits":
                raise SystemExit(3)
        raise KeyError("no such\nmode")


@pytest.mark.parametrize("how", ["nan", "overflow"])
def test_numbers_that_are_not_finite_are_a_divergence(how: str) -> None:
    plant = DynamicsPlant(Breaking(how))
    plant.reset([0])
    plant.step(np.zeros((1, 2)))
    assert plant.diverged_step.tolist() == [0]


@pytest.mark.parametrize(
    ("how", "words"),
    [
        (
            "shape",
            r"Breaking.step returned an array of shape \(2, 2\); expected numbers of shape \(3,\)",
        ),
        (
            "none",
            "Breaking.step returned NoneType, which is not an array of real numbers; expected",
        ),
        (
            "complex",
            "Breaking.step returned ndarray, which is not an array of real numbers; expected",
        ),
        ("changes z", r"Breaking.step changes its argument z, .* work on a copy, z.copy\(\)"),
        ("changes a", "Breaking.step changes its argument a"),
        (
            "raises",
            r"Breaking.step fails: .*test_unfit_dynamics.py, line \d+: KeyError: 'no such\\nmode'$",
        ),
        ("exits", r"Breaking.step fails: .*test_unfit_dynamics.py, line \d+: SystemExit: 3$"),
    ],
)
def test_a_step_that_is_wrong_is_told_in_one_sentence(how: str, words: str) -> None:
    plant = DynamicsPlant(Breaking(how))
    plant.reset([0])
    with pytest.raises(OwnCodeError, match=words) as refused:
        plant.step(np.zeros((1, 2)))
    assert "\n" not in str(refused.value)


class Unfit(Linear):
    def __init__(self, **changes: Any) -> None:
        super().__init__()
        vars(self).update(changes)

    def initial_state(self, rng: Any) -> Any:
        return getattr(self, "begins", np.zeros(3))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"n_z": 0}, "Unfit: expected n_z, the size of a state, or a grid"),
        ({"n_a": 0}, "Unfit: n_a must be at least 1, got 0"),
        ({"horizon": 2.5}, "Unfit: horizon must be a whole number, got 2.5"),
        ({"sample_time": -1.0}, "Unfit: sample_time must be positive and finite"),
        ({"sample_time": "0.05"}, "Unfit: sample_time must be positive and finite, got '0.05'"),
        ({"state_weight": "1"}, "Unfit: state_weight must be"),
        ({"divergence_bound": "1"}, "Unfit: divergence_bound must be positive and finite"),
        ({"action_low": "1"}, "Unfit: action_low must be"),
        ({"target": [1.0, 2.0]}, "Unfit: .*shape"),
        ({"target": None}, "Unfit: target must be an array of real numbers, got None"),
        ({"target": np.nan}, "Unfit: target must be finite"),
        ({"grid": pdeloop.Grid.vector(4)}, "Unfit: n_z is 3, but its grid has 4 numbers"),
        ({"supports": np.ones((3, 1))}, r"Unfit: supports must have shape \(3, 2\), got \(3, 1\)"),
    ],
)
def test_a_class_that_does_not_fit_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        DynamicsPlant(Unfit(**changes))


def test_a_class_without_actuators_is_refused() -> None:
    class Idle(pdeloop.Dynamics):
        n_z = 3

        def initial_state(self, rng: Any) -> Any:
            return np.zeros(3)

        def step(self, z: Any, a: Any) -> Any:
            return z

    with pytest.raises(ValueError, match=r"Idle must set n_a"):
        DynamicsPlant(Idle())


def test_a_number_that_is_a_method_is_refused() -> None:
    class Method(Linear):
        def target(self) -> Any:  # type: ignore[override]
            return np.zeros(3)

    with pytest.raises(ValueError, match=r"Method: target is a method; expected its value"):
        DynamicsPlant(Method())


def test_an_initial_state_that_is_wrong_is_told_and_changes_nothing() -> None:
    plant = DynamicsPlant(Unfit())
    plant.reset([0])
    plant.step(np.ones((1, 2)))
    before = plant.states.copy()
    for begins, words in (
        (np.full(3, np.inf), "Unfit.initial_state returned NaN or infinity"),
        (np.zeros(2), r"Unfit.initial_state returned an array of shape \(2,\)"),
        (
            np.full(3, -293.0),
            "Unfit.initial_state returned a state of magnitude 293, .*_bound, 100,",
        ),
    ):
        plant.dynamics.begins = begins
        with pytest.raises(OwnCodeError, match=words):
            plant.reset([1])
        assert np.array_equal(plant.states, before) and plant.step_index == 1


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("action_bounds", "expected 'action_low' and 'action_high'"),
        ("measurement_noise", "the parameter of a training, measurement_noise=…"),
    ],
)
def test_a_parameter_that_a_class_takes_for_an_attribute_is_named(name: str, meant: str) -> None:
    """It would have no effect."""
    with pytest.raises(
        ValueError, match=f"Own sets '{name}', which a plant does not have; .*{meant}"
    ):
        DynamicsPlant(type("Own", (Linear,), {name: 3.0})())


@pytest.mark.parametrize(("target", "bound"), [(0.3, 1e3), (1150.0, 1.15e6), (-6e7, 6e10)])
def test_a_bound_that_is_not_set_grows_with_the_target(target: float, bound: float) -> None:
    own = {"target": np.array([0.0, target, 0.0]), "divergence_bound": None}
    assert DynamicsPlant(type("Own", (Linear,), own)()).divergence_bound == bound


@pytest.mark.parametrize("moving", [False, True])
def test_a_target_beyond_the_divergence_bound_is_told(moving: bool) -> None:
    """A furnace in degrees: each of its rollouts would count as diverged."""
    target = np.tile([0.0, 1150.0, 0.0], (7, 1)) if moving else np.array([0.0, -1150.0, 0.0])
    own = {"target": target, "horizon": 6}
    with pytest.raises(ValueError, match=r"Own: the target has the magnitude 1150, .*_bound, 100,"):
        DynamicsPlant(type("Own", (Linear,), own)())
    assert DynamicsPlant(type("Own", (Linear,), {**own, "divergence_bound": 1e4})()).horizon == 6
