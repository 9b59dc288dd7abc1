# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of a method in one frozen dataclass: each with its meaning, its range and its unit."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from loop_interfaces.spec import Spec


def setting(
    default: float | bool | str,
    description: str,
    minimum: float | None = None,
    maximum: float | None = None,
    *,
    unit: str = "",
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare one constant of a `Settings`: a dataclass field with its range, ends included."""
    limits = {"minimum": minimum, "maximum": maximum, "unit": unit, "choices": choices}
    return field(default=default, metadata={**limits, "description": description})


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The constants of a method that can be set; derive from it, and declare each with `setting`.

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
    loop_interfaces.spec.ParameterError: setting 'step' is -1; expected a number from 1e-06 to 10
    """

    def __post_init__(self) -> None:
        for spec in self.specs():
            value = spec.check(getattr(self, spec.name), f"setting '{spec.name}'")
            object.__setattr__(self, spec.name, value)

    @classmethod
    def specs(cls) -> tuple[Spec, ...]:
        """What can be set, as parameters."""
        return tuple(
            Spec(item.name, item.default, **item.metadata)  # type: ignore[arg-type]
            for item in fields(cls)
            if "description" in item.metadata
        )
