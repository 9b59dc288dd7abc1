# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The parameters of a training: defaults of its optimiser and sensors, and the optimiser's settings."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller_node.identification import DesignSettings
from pdeloop.messages.problem import shipped_problems
from pdeloop.messages.spec import ParameterError
from pdeloop.method.adapt import ModelBased
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.models import FieldModelSettings
from pdeloop.problem_values import problem_values
from tests.support.small import SMALL
from tuner_node.build import build_training
from tuner_node.optimizer_parameters import settings_of, training_parameters

FEW = {"sensors": 16}
OBSERVER = {"law": "observer"}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, {"identification": "field"}),
        ({"optimizer": "two-point"}, {"identification": "dmdc"}),
        (
            {"optimizer": "two_point", "identification": "regression"},
            {"identification": "regression"},
        ),
        (FEW, {"law": "extended_kalman", "identification": "subspace"}),
        ({**FEW, "sensor_delays": 4}, {"law": "affine"}),  # a memory of another kind
        ({"sensors": 128}, {"law": "affine"}),  # every point
        ({"sensors": 0}, {"law": "affine"}),
        ({**FEW, "law": "affine"}, {"law": "affine", "identification": "field"}),
        ({**FEW, "optimizer": "two_point"}, {"law": "affine"}),  # which cannot improve it
        ({**FEW, **OBSERVER}, {"identification": "subspace"}),
        (OBSERVER, {"identification": "field"}),
        ({**FEW, **OBSERVER, "identification": "dmdc"}, {"identification": "dmdc"}),
    ],
)
def test_defaults_are_those_of_the_optimiser_and_the_sensors_and_override_nothing(
    given: dict[str, object], expected: dict[str, str]
) -> None:
    found = training_parameters("burgers", given)
    assert {name: found[name] for name in expected} == expected


def test_a_model_of_few_readings_is_not_that_of_the_file_for_the_whole_state() -> None:
    wave = problem_values("wave", FEW)[1]
    assert (wave["identification"], wave["reduced_order"]) == ("subspace", 0)
    for given, order in (
        ({"sensors": 0}, 30),
        ({**FEW, "reduced_order": 12}, 12),
        ({**FEW, "law": "affine"}, 30),
        ({**FEW, "identification": "field"}, 30),
    ):
        values = problem_values("wave", given)[1]
        assert values["reduced_order"] == order
        assert values["identification"] == ("subspace" if order == 12 else "field")
    # Where a model of the field between the sensors may follow, as of few sensors on a circle.
    for sensors, order in ((16, 8), (48, 0)):
        assert problem_values("burgers", {"sensors": sensors})[1]["reduced_order"] == order


def test_a_file_that_identifies_from_readings_names_their_order(tmp_path: Path) -> None:
    shipped = shipped_problems()["wave"].read_text()
    own = tmp_path / "own.yaml"
    own.write_text(shipped.replace("identification: field", "identification: subspace"))
    assert problem_values(str(own), {"sensors": 16})[1]["reduced_order"] == 30


def test_settings_are_parameters_of_the_training() -> None:
    chosen = {"optimizer": "model_based"}
    values = training_parameters("burgers", {**chosen, "optimizer_settings": {"judging": 5}})
    assert values["optimizer_settings.judging"] == 5
    assert settings_of(ModelBased, values) == ModelBasedSettings(judging=5)
    assert build_training({**values, "rollouts": 8}).settings.step == 6
    with pytest.raises(ParameterError, match=r"at least 8: .*6 for a step"):
        build_training({**values, "rollouts": 7})
    assert training_parameters("burgers", chosen)["optimizer_settings.judging"] == 3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"judging": 0}, "'optimizer_settings.judging' is 0; expected a whole number from 1 to"),
        ({"judging": "many"}, "'optimizer_settings.judging' is 'many'; expected a whole number"),
        (
            {"judgin": 2},
            "'optimizer_settings.judgin' of the optimizer 'model_based'; known: .*judging",
        ),
    ],
)
def test_settings_are_checked_before_anything_runs(options, words) -> None:
    with pytest.raises(ParameterError, match=words):
        training_parameters("burgers", {"optimizer": "model_based", "optimizer_settings": options})


def test_an_optimiser_without_settings_says_so() -> None:
    with pytest.raises(ParameterError, match="of the optimizer 'two_point'; it has no settings"):
        training_parameters("burgers", {"optimizer": "two_point", "optimizer_settings": {"r": 1.0}})


def test_the_constants_of_field_models_reach_controller_and_tuner() -> None:
    values = training_parameters(str(SMALL), {"field_model_settings": {"largest_degree": 2}})
    wanted = FieldModelSettings(largest_degree=2)
    assert values["field_model_settings.folds"] == FieldModelSettings().folds
    assert DesignSettings.of(values).field_models == wanted
    assert build_training(values).settings.field_models == wanted
    for wrong, words in (
        ({"largest_degree": 1}, "is 1; expected"),
        ({"degree": 2}, "unknown parameter"),
    ):
        with pytest.raises(ParameterError, match=f"{words}.*") as refused:
            training_parameters(str(SMALL), {"field_model_settings": wrong})
        assert "field_model_settings." in str(refused.value)
