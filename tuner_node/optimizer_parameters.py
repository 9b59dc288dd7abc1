# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The optimiser that the parameters name, and the settings of all methods."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from pdeloop.messages.parameters import LAW, OPTIMIZER, POINTS
from pdeloop.messages.problem import load_parameters
from pdeloop.messages.spec import OPTIMIZER_SETTINGS, ParameterError, Spec, flatten
from pdeloop.method.adapt import Optimizer
from pdeloop.method.adapt.registry import optimizer_kind
from pdeloop.method.method_settings import Method, law_of, shared_methods
from pdeloop.method.settings import parameters_of, with_defaults


def kind_of(values: Mapping[str, Any]) -> type[Optimizer]:
    """The class of the optimiser. ParameterError if there is none of that name."""
    try:
        return optimizer_kind(values["optimizer"])
    except ValueError as error:
        raise ParameterError(str(error)) from error


def _methods(values: Mapping[str, Any]) -> list[Method]:
    """The optimiser, and what controller and tuner share."""
    optimizer = Method(
        OPTIMIZER_SETTINGS, kind_of(values).Settings, f"optimizer '{values['optimizer']}'"
    )
    return [optimizer, *shared_methods(values)]


def setting_specs(values: Mapping[str, Any]) -> list[Spec]:
    """The settings of all methods as parameters."""
    return [spec for prefix, kind, _ in _methods(values) for spec in parameters_of(prefix, kind)]


def with_settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters with all settings of their methods, checked.

    ParameterError for a setting that the method does not have, or that is out of its range.
    """
    found = dict(values)
    for prefix, kind, method in _methods(values):
        found |= with_defaults(prefix, kind, values, method)
    return found


def settings_of(kind: type[Optimizer], values: Mapping[str, Any]) -> Any:
    """The settings of the optimiser of a training with these parameters."""
    given = with_settings(values)
    own = {spec.name: given[f"{OPTIMIZER_SETTINGS}{spec.name}"] for spec in kind.Settings.specs()}
    return kind.settings_of(values, own)


def training_parameters(
    name: str, options: Mapping[str, Any], *, constants: bool = False, late: bool = False
) -> dict[str, Any]:
    """Like `load_parameters`, with the optimiser's preferred defaults and all settings.

    options: by dotted names, or nested, as optimizer_settings={"fields": 5}; constants: whether the
    plant needs a law with constant parts of its own, late: whether its actions act late, where that is
    known.
    """
    own = flatten(options)
    preferred = partial(_preferred, options=own, constants=constants, late=late)
    return with_settings(load_parameters(name, own, preferred))


def _preferred(
    given: Mapping[str, Any], options: Mapping[str, Any], constants: bool, late: bool
) -> dict[str, Any]:
    """The given parameters with the defaults that the optimiser prefers.

    The law too may be one of few sensors, with the last actions, or with constant parts.

    A model of the whole field that a problem's file asks for, and the options do not, gives way to one
    of few readings. The optimiser's name may be written as the command line writes words: two-point.
    """
    name = str(given.get("optimizer", OPTIMIZER.default))
    name = name if ":" in name else name.replace("-", "_")
    kind = kind_of({"optimizer": name})
    preferences = dict(kind.preferences)
    # One at every point measures the whole state.
    few = (
        0 < _number(given, "sensors") < _number({POINTS.name: POINTS.default, **given}, POINTS.name)
    )
    few_now = few and _number(given, "sensor_delays") <= 1
    if (few_now or (few and constants)) and kind.law_of_sensors:
        preferences[LAW.name] = kind.law_of_sensors
    elif kind.law_with_actions and late and not few:
        preferences[LAW.name] = kind.law_with_actions
    elif kind.law_with_constants and constants:
        preferences[LAW.name] = kind.law_with_constants
    if few_now and given.get(LAW.name) in kind.laws_of_sensors:
        given = {**given, LAW.name: kind.laws_of_sensors[given[LAW.name]]}
    readings = law_of({**preferences, **given}).from_readings
    if few and readings:
        preferences["identification"] = readings
        if given.get("identification") == "field" and "identification" not in options:
            given = {**given, "identification": readings}
    return {**preferences, **given, "optimizer": name}


def _number(given: Mapping[str, Any], name: str) -> float:
    """A parameter as a number; 0 if it is not given, or is none, which is refused elsewhere."""
    try:
        return float(given.get(name, 0))
    except (TypeError, ValueError):
        return 0.0
