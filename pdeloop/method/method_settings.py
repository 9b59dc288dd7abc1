# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The methods whose constants parameters set for controller and tuner alike."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from pdeloop.messages.parameters import LAW
from pdeloop.messages.spec import (
    FIELD_MODEL_SETTINGS,
    IDENTIFICATION_SETTINGS,
    LAW_SETTINGS,
    ParameterError,
)
from pdeloop.method.laws.base import Law
from pdeloop.method.laws.registry import law_kind
from pdeloop.method.models.base import FieldModelSettings
from pdeloop.method.reduce.reduced_model import IdentificationSettings
from pdeloop.method.settings import Settings, settings_from

FIELD_MODELS = "models of the whole field"


class Method(NamedTuple):
    """The prefix of a method's parameters, the class of its constants, and its name in errors."""

    prefix: str
    settings: type[Settings]
    name: str


def field_model_settings(values: Mapping[str, Any]) -> FieldModelSettings:
    """The constants of field models that parameters give. ParameterError for one out of range."""
    return settings_from(FIELD_MODEL_SETTINGS, FieldModelSettings, values, FIELD_MODELS)


def law_of(values: Mapping[str, Any]) -> type[Law]:
    """The class of the law that parameters name. ParameterError if there is none of that name."""
    try:
        return law_kind(str(values.get("law", LAW.default)))
    except ValueError as error:
        raise ParameterError(str(error)) from error


def shared_methods(values: Mapping[str, Any]) -> list[Method]:
    """The methods that controller and tuner must agree on: law, identification, field models."""
    law = law_of(values)
    return [
        Method(LAW_SETTINGS, law.Settings, f"law '{values['law']}'"),
        Method(IDENTIFICATION_SETTINGS, IdentificationSettings, "identification"),
        Method(FIELD_MODEL_SETTINGS, FieldModelSettings, FIELD_MODELS),
    ]
