# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of identification, field models and laws are parameters, and steer what they say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import pdeloop
from controller_node.identification import DesignSettings
from pdeloop.messages.model_rows import ModelRows
from pdeloop.messages.spec import (
    FIELD_MODEL_SETTINGS,
    IDENTIFICATION_SETTINGS,
    OPTIMIZER_SETTINGS,
    ParameterError,
)
from pdeloop.method.adapt import Context, ModelBased, TwoPoint
from pdeloop.method.adapt.base import Record
from pdeloop.method.adapt.belief import believe
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from pdeloop.method.design.lqg import noise_of
from pdeloop.method.laws.registry import OWN_LAWS, law_kind
from pdeloop.method.models import FieldModelSettings, Measured
from pdeloop.method.reduce.reduced_model import IdentificationSettings
from pdeloop.method.reduce.regression import study_orders
from pdeloop.method.settings import Settings, setting
from tests.support.fitted import fit_field_model
from tests.support.interpreter import ROOT
from tests.support.small import SMALL
from tuner_node.build import build_training
from tuner_node.optimizer_parameters import training_parameters

OPTIMIZERS = (ModelBased, TwoPoint)


@dataclass(frozen=True, kw_only=True)
class LimitSettings(Settings):
    limit: float = setting(0.5, "magnitude that no action exceeds", 0.01, 1.0)


class Limited(pdeloop.Law):
    Settings = LimitSettings

    def start(self) -> dict[str, np.ndarray]:
        return {"K": np.full((1, 1), self.settings.limit)}  # type: ignore[attr-defined]

    def action(
        self, theta: dict[str, np.ndarray], z: np.ndarray, memory: np.ndarray, k: int
    ) -> np.ndarray:
        return theta["K"][0]


def test_the_settings_of_a_law_are_given_to_its_class(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(OWN_LAWS.variable, "")
    name = OWN_LAWS.take(Limited)
    assert law_kind(name) is Limited and Limited.settings == LimitSettings()
    other = law_kind(name, {"law_settings.limit": 0.25, "law": name})
    assert other.settings == LimitSettings(limit=0.25) and other.name == Limited.name
    assert Limited.settings == LimitSettings(), "the class itself is as it was"
    with pytest.raises(ParameterError, match=r"'law_settings\.limits' of the law .*known: law_set"):
        law_kind(name, {"law_settings.limits": 0.25})
    with pytest.raises(ParameterError, match="it has no settings"):
        law_kind("affine", {"law_settings.limit": 0.25})
    with pytest.raises(ParameterError, match=r"law_settings\.limit' is 2.*0\.01 to 1"):
        law_kind(name, {"law_settings.limit": 2.0})


def test_a_run_records_all_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(OWN_LAWS.variable, "")
    given = {"law": OWN_LAWS.take(Limited), "optimizer": "two_point"}
    values = training_parameters(
        str(SMALL), {**given, "identification_settings": {"order_folds": 2}}
    )
    assert values["law_settings.limit"] == 0.5
    assert values["identification_settings.order_folds"] == 2
    assert values["identification_settings.order_share"] == 0.8
    settings = DesignSettings.of(values)
    assert settings.method == IdentificationSettings(order_folds=2)
    assert law_kind(settings.law, settings.constants) is Limited
    with pytest.raises(ParameterError, match=r"parameter 'identification_settings\.folds'"):
        training_parameters(str(SMALL), {"identification_settings": {"folds": 2}})
    with pytest.raises(ParameterError, match="order_folds' is 1; expected"):
        training_parameters(str(SMALL), {"identification_settings": {"order_folds": 1}})


def test_a_larger_share_suggests_a_higher_order() -> None:
    """Of a plant whose modes matter less and less, all of what the best order gains needs it."""
    rng = np.random.default_rng(0)
    A = np.diag([0.9, 0.8, 0.7, 0.6])
    B = np.diag([1.0, 0.3, 0.1, 0.03]) @ rng.normal(size=(4, 2))
    a, z = rng.normal(size=(160, 2)), np.zeros((161, 4))
    for k in range(160):
        z[k + 1] = A @ z[k] + B @ a[k] + 1e-6 * rng.normal(size=4)

    def suggested(share: float) -> int:
        return study_orders([(z, a)], settings=IdentificationSettings(order_share=share)).suggested

    assert suggested(0.0) == 1
    assert suggested(1.0) == 4
    assert suggested(0.0) <= suggested(0.3) <= suggested(1.0)


def test_noise_has_to_show_by_as_many_standard_errors_as_are_set() -> None:
    """Of what certainly has noise, an absurd demand leaves none."""
    rng = np.random.default_rng(1)
    a, s = rng.normal(size=(400, 1)), np.zeros((401, 2))
    A, B = np.array([[0.8, 0.2], [-0.2, 0.8]]), np.array([[1.0], [0.5]])
    for k in range(400):
        s[k + 1] = A @ s[k] + B @ a[k]
    z, none = s + 0.3 * rng.normal(size=s.shape), np.zeros((1, 2))
    rows = ModelRows(A=A, B=B, U=np.eye(2), K_a=none, K_b=none, s_r=none[0])
    found = {
        errors: noise_of(rows, [(z, a)], IdentificationSettings(noise_evidence=errors))
        for errors in (2.0, 100.0)
    }
    assert found[2.0][1][0, 0] == pytest.approx(0.09, rel=0.3)
    assert found[100.0][1][0, 0] < 1e-3


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


def cubic(count: int) -> list[Measured]:
    """Rollouts of a damped cubic equation at every point, which no equation of degree 2 reproduces."""
    rng, found = np.random.default_rng(2), []
    for _ in range(count):
        a, z = rng.normal(size=(40, 1)), np.empty((41, 16))
        z[0] = np.sin(2.0 * np.pi * (np.arange(16) / 16 + rng.random()))
        for k in range(40):
            z[k + 1] = z[k] + 0.1 * (z[k] - z[k] ** 3) + 0.05 * a[k]
        found.append(Measured(z, a))
    return found


def test_kinds_of_a_higher_degree_than_is_set_are_not_tried() -> None:
    rollouts, kinds = cubic(3), {}
    for degree in (2, 7):
        settings = FieldModelSettings(largest_degree=degree)
        found = fit_field_model(rollouts, np.zeros(16), settings=settings)
        assert found is not None
        kinds[degree] = {kind for kind, _ in found.candidates}
    assert "poly3" in kinds[7] and "poly3" not in kinds[2] and "poly2" in kinds[2]


def test_an_optimiser_fits_its_models_with_the_constants_of_its_context() -> None:
    """A kind is tried until one reproduces the data: where any error is good enough, only the first."""
    records = [Record(np.zeros((1, 2)), np.inf, own.states, own.actions) for own in cubic(3)]
    first = (records[0].states, records[0].actions)
    tried = {}
    for reproduced in (0.0, 1.0):
        settings = FieldModelSettings(reproduced=reproduced, worst=1.0)
        context = Context(
            np.eye(16)[:, :1], np.zeros(16), 1.0, 1.0, 40, first, field_models=settings
        )
        belief = believe(context, records, 0.05, "linear")
        assert belief is not None
        tried[reproduced] = belief.model.kind
    assert tried[1.0] == "linear" != tried[0.0]


def test_the_tables_of_settings_are_those_of_the_classes() -> None:
    """One table for each method on one page, with every constant that can be set."""
    assert {kind.name for kind in OPTIMIZERS} == set(OWN_OPTIMIZERS.shipped)
    tables = [
        (f"`{IDENTIFICATION_SETTINGS}NAME`", IdentificationSettings),
        (f"`{FIELD_MODEL_SETTINGS}NAME`", FieldModelSettings),
        *((f"`{OPTIMIZER_SETTINGS}NAME` of `{kind.name}`", kind.Settings) for kind in OPTIMIZERS),
    ]
    tables = [(title, kind) for title, kind in tables if kind.specs()]
    text = (ROOT / "docs" / "reference" / "settings.md").read_text()
    documented = {}
    for section in text.split("\n## ")[1:]:
        rows = [
            [cell.strip(" `") for cell in line.split("|")[1:-1]] for line in section.splitlines()
        ]
        if settings := [tuple(row) for row in rows if len(row) == 4][2:]:
            documented[section.splitlines()[0]] = settings
    assert documented == {
        title: [
            (
                spec.name,
                str(spec.default),
                spec.range.partition("from ")[2],
                spec.description,
            )
            for spec in kind.specs()
        ]
        for title, kind in tables
    }
