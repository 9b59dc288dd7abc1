# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What the parameters say of the optimiser: which it is, and its settings `optimizer_settings.*`."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from loop_interfaces.parameters import OPTIMIZER
from loop_interfaces.problem import load_parameters
from loop_interfaces.spec import OPTIMIZER_SETTINGS, ParameterError, Spec, flatten
from loop_method.adapt import Optimizer
from loop_method.adapt.registry import optimizer_kind


def kind_of(values: Mapping[str, Any]) -> type[Optimizer]:
    """The class of the optimiser. ParameterError if there is none of that name."""
    try:
        return optimizer_kind(values["optimizer"])
    except ValueError as error:
        raise ParameterError(str(error)) from error


def setting_specs(kind: type[Optimizer]) -> list[Spec]:
    """The settings of an optimiser as parameters."""
    return [
        replace(spec, name=f"{OPTIMIZER_SETTINGS}{spec.name}") for spec in kind.Settings.specs()
    ]


def with_settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters with all settings of their optimiser, checked.

    ParameterError for a setting that it does not have, or that is out of its range.
    """
    specs = {spec.name: spec for spec in setting_specs(kind_of(values))}
    given = {name: value for name, value in values.items() if name.startswith(OPTIMIZER_SETTINGS)}
    for name in given:
        if name not in specs:
            close = difflib.get_close_matches(name, specs, n=1) or specs
            known = f"known: {', '.join(close)}" if close else "it has no settings"
            raise ParameterError(
                f"unknown parameter '{name}' of the optimizer '{values['optimizer']}'; {known}"
            )
    checked = {
        name: spec.check(given.get(name, spec.default), f"parameter '{name}'")
        for name, spec in specs.items()
    }
    return {**values, **checked}


def settings_of(kind: type[Optimizer], values: Mapping[str, Any]) -> Any:
    """The settings of the optimiser of a training with these parameters."""
    given = with_settings(values)
    own = {spec.name: given[f"{OPTIMIZER_SETTINGS}{spec.name}"] for spec in kind.Settings.specs()}
    return kind.settings_of(values, own)


def training_parameters(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Like `load_parameters`, with the optimiser's preferred defaults and its settings.

    options: by dotted names, or nested, as optimizer_settings={"fields": 5}.
    """
    return with_settings(load_parameters(name, flatten(options), _preferred))


def _preferred(given: Mapping[str, Any]) -> dict[str, Any]:
    """The given parameters with the defaults that their optimiser prefers.

    The optimiser's name may be written as the command line writes words: gauss-newton.
    """
    name = str(given.get("optimizer", OPTIMIZER.default))
    name = name if ":" in name else name.replace("-", "_")
    return {**kind_of({"optimizer": name}).preferences, **given, "optimizer": name}
