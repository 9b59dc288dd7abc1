# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Which optimiser a name stands for, what it declares, and its settings as parameters."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from pdeloop.messages.problem import shipped_problems
from pdeloop.messages.spec import ParameterError
from pdeloop.method.adapt import ModelBased, Optimizer, TwoPoint
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS, optimizer_kind
from pdeloop.method.settings import Settings, setting
from pdeloop.problem_values import problem_values
from tests.support.small import parameters, same_bits, train_here
from tuner_node.build import build_training
from tuner_node.optimizer_parameters import settings_of, training_parameters

FOREIGN = """
from pdeloop.method.adapt.two_point import TwoPoint

class Halved(TwoPoint):
    name = "halved"
    preferences = {"identification": "field"}

    def tell(self, results):
        return super().tell(results) | {"halved": True}

class Whole(TwoPoint):
    name = "whole"

class Partial:
    name = "partial"

NUMBER = 3
"""


def offer(folder: Path, package: str, *entries: str) -> None:
    """What an installation of a package leaves: its metadata, with entry points."""
    about = folder / f"{package}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("\n".join(["[pdeloop.optimizers]", *entries]))


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "foreign.py").write_text(FOREIGN)
    monkeypatch.syspath_prepend(str(tmp_path))
    entries = "halved = foreign:Halved", "two_point = foreign:Whole", "partial = foreign:Partial"
    offer(tmp_path, "first", *entries, "lost = foreign:Lost", "number = foreign:NUMBER")
    yield tmp_path
    sys.modules.pop("foreign", None)


def test_ours_are_offered_as_those_of_others_are() -> None:
    assert optimizer_kind("model_based") is ModelBased
    assert optimizer_kind("two_point") is TwoPoint


def test_an_installed_package_offers_its_optimisers_by_name(installed: Path) -> None:
    assert optimizer_kind("halved").name == "halved"
    assert optimizer_kind("two_point") is TwoPoint, "no package takes a name of ours"
    assert {"halved", "two_point", "model_based"} <= set(OWN_OPTIMIZERS.offered())
    offer(installed, "second", "halved = foreign:Whole")
    with pytest.raises(ValueError, match="'halved' is offered by several installed packages"):
        optimizer_kind("halved")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "adam",
            "unknown optimizer 'adam': give one of model_based, two_point, halved, .*",
        ),
        ("gauss_newton", "'gauss_newton' was removed: use model_based, or two_point"),
        ("lost", "'lost': foreign:Lost cannot be loaded: .*Lost"),
        ("number", "'number': 3 must be a class"),
        ("partial", "'partial': Partial does not define ask, tell, .*needs_trajectories"),
    ],
)
def test_what_is_no_optimiser_is_refused_in_a_sentence(installed: Path, name, words) -> None:
    with pytest.raises(ValueError, match=words) as refused:
        optimizer_kind(name)
    assert "\n" not in str(refused.value)


def test_one_of_another_package_trains_with_what_it_declares(installed: Path) -> None:
    """It is TwoPoint by another name, and comes to the same policy."""
    own = train_here(parameters(optimizer="halved", iterations=3))
    assert all(row["halved"] for row in own.history)
    ours = train_here(parameters(optimizer="two_point", iterations=3))
    assert same_bits(own.policies(), ours.policies())
    assert training_parameters("burgers", {"optimizer": "halved"})["identification"] == "field"


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


def test_settings_know_their_ranges() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Own(Settings):
        step: float = setting(0.1, "length of a step", 1e-6, 10.0, unit="m")
        norm: str = setting("l2", "norm of a step", choices=("l1", "l2"))

    assert Own(step=2) == Own(step=2.0)
    for wrong, words in (({"step": 11.0}, "from 1e-06 to 10 \\(m\\)"), ({"norm": "l3"}, "l1, l2")):
        with pytest.raises(ParameterError, match=words):
            Own(**wrong)
    assert [spec.name for spec in Own.specs()] == ["step", "norm"]
    assert Optimizer.Settings.specs() == ()
