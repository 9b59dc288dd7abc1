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
    ParameterError,
)
from pdeloop.method.design.lqg import noise_of
from pdeloop.method.laws.registry import OWN_LAWS, law_kind
from pdeloop.method.models import FieldModelSettings, Measured
from pdeloop.method.reduce.reduced_model import IdentificationSettings
from pdeloop.method.reduce.regression import study_orders
from pdeloop.method.settings import Settings, setting
from tests.support.fitted import fit_field_model
from tests.support.small import SMALL
from tuner_node.optimizer_parameters import training_parameters


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
