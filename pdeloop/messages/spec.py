# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A parameter as data, with its valid values. No ROS import."""

from __future__ import annotations

import contextlib
import difflib
import math
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pdeloop.messages.documents import parse_yaml
from pdeloop.messages.files import FileError, read_bounded
from pdeloop.messages.text import shown

Value = bool | int | float | str | list[str] | list[float]
OPTIMIZER_SETTINGS = "optimizer_settings."
LAW_SETTINGS = "law_settings."
IDENTIFICATION_SETTINGS = "identification_settings."
FIELD_MODEL_SETTINGS = "field_model_settings."
SETTINGS = (OPTIMIZER_SETTINGS, LAW_SETTINGS, IDENTIFICATION_SETTINGS, FIELD_MODEL_SETTINGS)
"""Prefixes of parameters that are constants of a method."""
FREE = ("physical.", *SETTINGS)
"""Prefixes of parameters that an equation, a plant or a method declares."""
MAX_YAML_BYTES = 4_000_000
MAX_PARAMETERS, MAX_NAME = 10_000, 500
_FILE_NAME = re.compile(r"[^\W_][\w.-]{,99}")
_EXPONENT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)[eE][+-]?\d+")


class ParameterError(ValueError):
    """A parameter that is missing, unknown or out of range; the text names it, its value and range."""


@dataclass(frozen=True)
class Spec:
    """One parameter. The type is the default's; `required` ones have no usable default.

    minimum, maximum: inclusive, unless `positive` (then value > 0); a list that has them is one of
    numbers in this range, and one of texts otherwise. choices: the allowed words.
    live: it may be changed while the node runs, because no result depends on it. file_name: a text that
    names files and folders, and therefore holds no path. nodes: letters of the nodes that take it
    (pdeloop.messages.parameters.NODES). group: heading of `pdeloop train --help` under which its flag
    stands; empty: it has none.
    """

    name: str
    default: Value
    minimum: float | None = None
    maximum: float | None = None
    unit: str = ""
    choices: tuple[str, ...] = ()
    positive: bool = False
    multiple_of: int = 1
    live: bool = False
    file_name: bool = False
    nodes: str = ""
    group: str = ""
    description: str = ""

    def means(self, description: str) -> Spec:
        """The same parameter with its description.

        >>> Spec("horizon", 300, minimum=1).means("steps of an episode").description
        'steps of an episode'
        """
        return replace(self, description=description)

    @property
    def flag(self) -> str:
        """The flag on the command line."""
        return f"--{self.name.replace('_', '-')}"

    @property
    def type(self) -> type:
        return type(self.default)

    @property
    def numbers(self) -> bool:
        """True if it is a list of numbers."""
        return self.type is list and self.minimum is not None

    @property
    def range(self) -> str:
        """The allowed values in words."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.file_name:
            return "at most 100 letters, digits, '_', '-' and '.', beginning with a letter or digit"
        words = {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}
        text = words.get(self.type, "a list of numbers" if self.numbers else "a list of texts")
        if self.multiple_of == 2:
            text = "an even whole number"
        if self.positive:
            text += " above 0"
        elif self.minimum is not None and self.maximum is not None:
            return f"{text} from {_plain(self.minimum)} to {_plain(self.maximum)}"
        elif self.minimum is not None:
            text += f" of at least {_plain(self.minimum)}"
        if self.maximum is not None:
            text += f", at most {_plain(self.maximum)}"
        return text

    def check(self, value: Any, called: str = "") -> Value:
        """`value` in the parameter's type; raises ParameterError naming value and range.

        called: what the user calls it, if not by the parameter's name.
        """
        value = value.tolist() if hasattr(value, "tolist") else value  # NumPy's
        good: Value | None = self._coerce(value)
        if good is None:
            called = called or f"parameter '{self.name}'"
            raise ParameterError(
                f"{called} is {shown(value)}; expected {self.range}"
                + (f" ({self.unit})" if self.unit else "")
                + (exponent_hint(value) if self.type is float else "")
                + ("" if _normal(value) else f"; {_NEAR_ZERO}")
            )
        return good

    def parse(self, text: str) -> Value:
        """The value that a text stands for, as in a launch argument; a ParameterError if it is bad.

        >>> Spec("horizon", 300, minimum=1).parse("20")
        20
        >>> Spec("actuator_positions", [], 0.0, 1.0).parse("0.1, 0.5")
        [0.1, 0.5]
        """
        words = {"true": True, "false": False}
        value: Any = words.get(text, text) if self.type is bool else text
        with contextlib.suppress(ValueError):
            if self.type in (int, float):
                value = self.type(text)
            elif self.numbers:
                value = [float(part) for part in text.strip("[] ").split(",")]
        return self.check(value)

    def _coerce(self, value: Any) -> Any:
        if self.type is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value) if abs(value) < 2**1000 else math.inf
        if self.numbers:
            return self._coerce_numbers(value)
        if not isinstance(value, self.type) or (self.type is int and isinstance(value, bool)):
            return None
        if isinstance(value, str) and "\0" in value:  # no name of a file or a class
            return None
        if isinstance(value, list):
            return value if all(isinstance(item, str) for item in value) else None
        if self.choices:
            return value if value in self.choices else None
        if self.file_name:
            return value if _FILE_NAME.fullmatch(str(value)) else None
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            unfit = isinstance(value, float) and not (math.isfinite(value) and _normal(value))
            if unfit or (self.positive and value <= 0):
                return None
            if self.minimum is not None and value < self.minimum:
                return None
            if self.maximum is not None and value > self.maximum:
                return None
            if isinstance(value, int) and value % self.multiple_of:
                return None
        return value

    def _coerce_numbers(self, value: Any) -> list[float] | None:
        """A list or a tuple of numbers in the range, as a list."""
        if not isinstance(value, list | tuple):
            return None
        number = replace(self, default=0.0)
        found = [number._coerce(item) for item in value]
        return None if None in found else [float(item) for item in found]


_NEAR_ZERO = "a number so near to 0 cannot be written to a file and read back"


def _normal(value: object) -> bool:
    """False for a number that is not 0, and nearer to it than a parameter file can say."""
    near = isinstance(value, float) and abs(value) < sys.float_info.min
    return not near or value == 0.0


def _plain(number: float) -> str:
    """A bound as people write it: 1000000, not 1e+06."""
    whole = float(number).is_integer() and abs(number) < 1e17
    return str(int(number)) if whole else f"{number:g}"


def assignment(text: str) -> tuple[str, Value]:
    """Name and value of a text 'NAME=VALUE'; its parameter checks the value later.

    >>> assignment("physical.viscosity=1e-3")
    ('physical.viscosity', 0.001)
    """
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise ParameterError(f"{shown(text)} is not of the form NAME=VALUE")
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return name, kind(value)
    return name, {"true": True, "false": False}.get(value, value)


def exponent_hint(value: object) -> str:
    """Advice on a text like '1e12', which YAML 1.1 does not read as a number; else empty."""
    if isinstance(value, str) and len(value) < 100 and _EXPONENT.fullmatch(value):
        return "; in YAML a number with an exponent needs a point and a sign, like 1.0e+12"
    return ""


def check_names(names: Iterable[str], known: Iterable[str]) -> None:
    """Raises ParameterError for the first name that is not known, with the nearest known one."""
    known = list(known)
    for name in names:
        if name not in known and not name.startswith(FREE):
            close = difflib.get_close_matches(name, known, n=1, cutoff=0.7)
            own = shown(f"physical.{name}")
            hint = (
                f"did you mean '{close[0]}'?"
                if close
                else "docs/parameters.md lists all; a constant of the equation or plant is given "
                f"as {own}"
            )
            raise ParameterError(f"unknown parameter {shown(name)}; {hint}")


def check(specs: Iterable[Spec], given: Mapping[str, Any]) -> dict[str, Any]:
    """Every parameter of `specs`, from `given` or its default, checked against its range."""
    return {spec.name: spec.check(given.get(spec.name, spec.default)) for spec in specs}


def read_document(path: Path) -> Any:
    """The content of a YAML file of bounded size. ParameterError when it cannot be read."""
    try:
        raw = read_bounded(path, MAX_YAML_BYTES, "expected a parameter file")
    except FileError as error:
        raise ParameterError(str(error)) from error
    try:
        return parse_yaml(raw)
    except ValueError as error:
        raise ParameterError(f"{path} is not valid YAML: {error}") from error


def flatten(body: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Nested parameters by dotted names."""
    flat: dict[str, Any] = {}
    for key, value in body.items():
        name = f"{prefix}{key}"
        if len(name) > MAX_NAME:
            raise ParameterError(
                f"the name of a parameter has more than {MAX_NAME} characters: {shown(name)}"
            )
        if isinstance(value, dict):
            flat.update(flatten(value, f"{name}."))
        else:
            flat[name] = value
        if len(flat) > MAX_PARAMETERS:
            raise ParameterError(f"more than {MAX_PARAMETERS} parameters in one file")
    return flat
