# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Where the problems are, and a problem's resolved parameters. No ROS import."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from loop_interfaces.parameters import table, with_budget
from loop_interfaces.spec import (
    OPTIMIZER_SETTINGS,
    ParameterError,
    check,
    check_names,
    exponent_hint,
    read_yaml,
)
from loop_interfaces.text import shown


def config_folder() -> Path:
    """The folder of the shipped configuration.

    Beside the sources, or PREFIX/share/pdeloop/config of an installation under PREFIX: a virtual
    environment, or the install folder of a colcon workspace, which Python does not know as a prefix.
    """
    here = Path(__file__).resolve()
    beside = here.parent.parent / "config"
    installed = (prefix / "share" / "pdeloop" / "config" for prefix in here.parents)
    return next((f for f in (beside, *installed) if (f / "problems").is_dir()), beside)


def shipped_problems() -> dict[str, Path]:
    """Name and file of every shipped problem."""
    folder = config_folder() / "problems"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"), key=lambda path: path.stem)}


def find_problem(name: str) -> Path:
    """The YAML file of a shipped problem's name or of a path; ParameterError if there is none."""
    shipped = shipped_problems()
    if name in shipped:
        return shipped[name]
    path = Path(name)
    if path.suffix in (".yaml", ".yml") or path.exists():
        if not path.is_file():
            raise ParameterError(f"no problem file at {name}; give the path of a YAML file")
        return path
    raise ParameterError(
        f"unknown problem '{name}'; expected one of {', '.join(shipped)}, or the path of a YAML file"
    )


def load_parameters(
    name: str,
    options: Mapping[str, Any],
    preferred: Callable[[Mapping[str, Any]], Mapping[str, Any]] = lambda given: given,
) -> dict[str, Any]:
    """The checked parameters of all nodes: a problem's file, then `options`, then the defaults.

    preferred: adds defaults that depend on what is given. `physical.*` and `optimizer_settings.*` are
    included as given; a relative file of an equation ('file.py:Class') is taken
    relative to the YAML file.
    """
    path = find_problem(name)
    given = dict(preferred({**read_yaml(path), **options}))
    check_names(given, [spec.name for spec in table()])
    given["equation"] = _equation_path(str(given.get("equation", "")), path)
    settings = {k: value for k, value in given.items() if k.startswith(OPTIMIZER_SETTINGS)}
    return {**with_budget(check(table(), given)), **_physical(given), **settings}


def _physical(given: Mapping[str, Any]) -> dict[str, float]:
    physical: dict[str, float] = {}
    for name, value in given.items():
        if name.startswith("physical."):
            value = value.tolist() if hasattr(value, "tolist") else value  # NumPy's
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise ParameterError(
                    f"parameter '{name}' is {shown(value)}; expected a number{exponent_hint(value)}"
                )
            physical[name] = math.inf if abs(value) >= 2**1000 else float(value)
    return physical


def _equation_path(equation: str, yaml_file: Path) -> str:
    file, colon, name = equation.rpartition(":")
    if colon and file.endswith(".py") and not Path(file).is_absolute():
        return f"{(yaml_file.resolve().parent / file)}:{name}"
    return equation or "burgers"
