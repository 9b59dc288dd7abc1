# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The flag --set NAME=VALUE: any parameter, by its name in docs/parameters.md."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable, Mapping
from typing import Any

from pdeloop.messages.parameters import table
from pdeloop.messages.spec import SETTINGS, ParameterError, assignment, check_names
from pdeloop.messages.text import shown

PHYSICAL = "physical."
"""Before the name of a parameter of the equation; `SETTINGS` are those of a method's."""
OF_AN_FMU = "fmu."
"""The same for an FMU, whose parameters may be texts and lists."""
_COMMA = re.compile(r",(?![^\[]*\])")
"""One between values, not between the indices of A[1,2]."""
OWN_FLAGS = {
    "out": "--out",
    "resume": "--resume",
    "model": "--model",
    "pairs": "--pairs",
    "recorder": "--record",
    "bag": "--record",
    "cost": "--plant",
}
"""Parameters that follow from a flag of the command, or are not a training's."""


def add_set(
    parser: argparse._ActionsContainer, what: str = "any parameter", *, trains: bool = True
) -> None:
    """The flag --set, which may be given several times. trains: whether methods have settings."""
    methods = "; {}NAME, {}NAME and {}NAME for one of a method".format(*SETTINGS)
    action = parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"{what}, by its name in docs/parameters.md; {PHYSICAL}NAME for one of the equation"
        f"{methods if trains else ''}; may be repeated",
    )

    def complete(prefix: str, **_: object) -> list[str]:
        return [f"{spec.name}=" for spec in table() if spec.name.startswith(prefix)]

    action.completer = complete  # type: ignore[attr-defined]  # as argcomplete asks for it


def read_settings(texts: Iterable[str]) -> dict[str, Any]:
    """The parameters that --set gives, checked one by one.

    ParameterError, one sentence, for an unknown name, a value out of range, and one given twice.

    >>> read_settings(["horizon=20", "physical.viscosity=1e-3", "actuator_positions=0.1,0.5"])
    {'horizon': 20, 'physical.viscosity': 0.001, 'actuator_positions': [0.1, 0.5]}
    """
    found: dict[str, Any] = {}
    specs = {spec.name: spec for spec in table()}
    for text in texts:
        name, given, value = (part.strip() for part in text.partition("="))
        name = name if "." in name else name.lstrip("-").replace("-", "_")
        if not (given and name):
            raise ParameterError(
                f"--set is {shown(text)}; expected NAME=VALUE, such as horizon=100"
            )
        if name in found:
            raise ParameterError(f"parameter '{name}' is given twice; give it once")
        if name.startswith(OF_AN_FMU):
            found[PHYSICAL + name.removeprefix(OF_AN_FMU)] = _value(value)
            continue
        if name.startswith(PHYSICAL):
            found[name] = {"true": True, "false": False}.get(value, _value(value))
            continue
        if name.startswith(SETTINGS):  # the method knows what the value has to be
            found[name] = assignment(f"{name}={value}")[1]
            continue
        check_names([name], specs)
        if name in OWN_FLAGS:
            raise ParameterError(f"--set {name}: give {OWN_FLAGS[name]}, which sets it")
        spec = specs[name]
        if spec.choices:
            value = value.replace("-", "_")
        found[name] = spec.parse(value)
    return found


def joined(flags: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of flags and of --set together; ParameterError for one that both give."""
    if both := sorted({*flags} & {*settings}):
        raise ParameterError(f"parameter '{both[0]}' is given twice; give it once")
    return {**flags, **settings}


def _value(text: str) -> float | str | list[float] | list[str]:
    """A number, a text, or a list of either.

    >>> _value("T[1,1],T[1,2]"), _value("0.5"), _value("20,30")
    (['T[1,1]', 'T[1,2]'], 0.5, [20.0, 30.0])
    """
    parts = [part.strip() for part in _COMMA.split(text)]
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        return parts if len(parts) > 1 else text
    return numbers if len(numbers) > 1 else numbers[0]
