# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of a method in one frozen dataclass: each with its meaning, its range and its unit."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

from pdeloop.messages.spec import ParameterError, Spec

_Own = TypeVar("_Own", bound="Settings")


def setting(
    default: float | bool | str,
    description: str,
    minimum: float | None = None,
    maximum: float | None = None,
    *,
    unit: str = "",
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare one constant of a `Settings`.

    Parameters
    ----------
    default
        Default value; its type is that of the constant.
    description
        Meaning, for tables and errors.
    minimum, maximum
        Its range, ends included; None: unbounded.
    unit
        Unit of its value.
    choices
        Admissible values of a text.

    Returns
    -------
    dataclasses.Field
    """
    limits = {"minimum": minimum, "maximum": maximum, "unit": unit, "choices": choices}
    return field(default=default, metadata={**limits, "description": description})


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Base class of a method's constants; declare each with `setting`.

    Raises
    ------
    ParameterError
        A value has the wrong type or lies outside its range.

    Examples
    --------
    >>> @dataclass(frozen=True, kw_only=True)
    ... class OfADescent(Settings):
    ...     step: float = setting(0.1, "length of a step", 1e-6, 10.0)
    >>> OfADescent(step=1).step
    1.0
    >>> OfADescent(step=-1)
    Traceback (most recent call last):
    pdeloop.messages.spec.ParameterError: setting 'step' is -1; expected a number from 1e-06 to 10
    """

    def __post_init__(self) -> None:
        for spec in self.specs():
            value = spec.check(getattr(self, spec.name), f"setting '{spec.name}'")
            object.__setattr__(self, spec.name, value)

    @classmethod
    def specs(cls) -> tuple[Spec, ...]:
        """The settings as parameters."""
        return tuple(
            Spec(item.name, item.default, **item.metadata)  # type: ignore[arg-type]
            for item in fields(cls)
            if "description" in item.metadata
        )


def parameters_of(prefix: str, kind: type[Settings]) -> list[Spec]:
    """The settings as parameters, whose names begin with the prefix."""
    return [replace(spec, name=f"{prefix}{spec.name}") for spec in kind.specs()]


def with_defaults(
    prefix: str, kind: type[Settings], values: Mapping[str, Any], method: str
) -> dict[str, Any]:
    """All settings of a method by their names as parameters, checked.

    values: parameters, with any others among them; method: what it is called in errors.
    ParameterError for a setting that it does not have, or that is out of its range.
    """
    specs = {spec.name: spec for spec in parameters_of(prefix, kind)}
    given = {name: value for name, value in values.items() if name.startswith(prefix)}
    for name in given:
        if name not in specs:
            close = difflib.get_close_matches(name, specs, n=1) or specs
            known = f"known: {', '.join(close)}" if close else "it has no settings"
            raise ParameterError(f"unknown parameter '{name}' of the {method}; {known}")
    return {
        name: spec.check(given.get(name, spec.default), f"parameter '{name}'")
        for name, spec in specs.items()
    }


def settings_from(prefix: str, kind: type[_Own], values: Mapping[str, Any], method: str) -> _Own:
    """The settings that parameters give; arguments as for `with_defaults`."""
    found = with_defaults(prefix, kind, values, method)
    return kind(**{name.removeprefix(prefix): value for name, value in found.items()})
