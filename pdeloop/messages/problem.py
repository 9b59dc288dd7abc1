# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Problem files, and a problem's resolved parameters. No ROS import."""

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pdeloop.messages.loop_parameters import read_problem
from pdeloop.messages.own_code import FMU, PROCESS, absolute_words
from pdeloop.messages.parameters import (
    OF_THE_PLANT,
    POINTS,
    PROBLEM,
    table,
    with_budget,
    with_names,
)
from pdeloop.messages.spec import SETTINGS, ParameterError, check, check_names, exponent_hint
from pdeloop.messages.text import alike, shown


def config_folder() -> Path:
    """The folder of the shipped configuration.

    Next to the sources, or PREFIX/share/pdeloop/config of an installation under PREFIX: a virtual
    environment, or the install folder of a colcon workspace, which Python does not know as a prefix.
    """
    here = Path(__file__).resolve()
    beside = here.parents[2] / "config"
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
    if ".py" in (path.suffix, path.suffix.partition(":")[0]):
        raise ParameterError(
            f"expected the name of a problem or the path of a YAML file, got {shown(name)}; a plant of "
            "your own is given as --plant FILE.py:CLASS"
        )
    if path.suffix in (".yaml", ".yml") or path.exists():
        if not path.is_file():
            raise ParameterError(f"no problem file at {name}; give the path of a YAML file")
        return path
    raise ParameterError(
        f"unknown problem '{name}'; {alike(name, shipped)}expected one of {', '.join(shipped)}, or the "
        "path of a YAML file"
    )


def load_parameters(
    name: str,
    options: Mapping[str, Any],
    preferred: Callable[[Mapping[str, Any]], Mapping[str, Any]] = lambda given: given,
) -> dict[str, Any]:
    """The checked parameters of all nodes: a problem's file, then `options`, then the defaults.

    preferred: adds defaults that depend on what is given. `physical.*` and the settings of methods are
    included as given; a relative file of user code ('file.py:Class') is relative to the YAML file.
    name: empty where the options name a plant, which needs no file. What a plant of a user's own says
    itself (OF_THE_PLANT) is left out where nothing else is given.
    """
    path = find_problem(name) if name or not options.get("plant") else None
    given = with_names({**(read_problem(path) if path else {}), **options})
    given = completed(given, "pde_sim_node")
    check_names(given, [spec.name for spec in table()])
    folder = path.resolve().parent if path else Path.cwd()
    for code in ("equation", "plant"):
        given[code] = code_from(folder, str(given.get(code, "")))
    for code in ("optimizer", "law"):
        if code in given:
            given[code] = code_from(folder, str(given[code]))
    given = dict(preferred(given))
    if given["plant"]:
        given.setdefault("problem", _words(given["plant"]))
        values = own_values(given, check(table(), given))
    else:
        given["equation"] = given["equation"] or "burgers"
        POINTS.check(given.get("n_z", POINTS.default))
        values = check(table(), given)
    settings = {k: value for k, value in given.items() if k.startswith(SETTINGS)}
    return with_budget(values) | _physical(given) | settings


def completed(given: Mapping[str, Any], package: str) -> dict[str, Any]:
    """The parameters given to a node, on top of the shipped problem that they name.

    ParameterError for an unknown problem: of a plant without an equation, and of another node
    without anything else. Their defaults would be another problem's.
    """
    name = given.get("problem")
    own = given.get("equation") or given.get("plant")
    if name is None or own or package == "recorder_node":
        return dict(given)
    shipped = shipped_problems()
    if name in shipped:
        return {**read_problem(shipped[name]), **given}
    others = {spec.name for spec in PROBLEM if spec.name in given} - {"problem"}
    if package != "pde_sim_node" and others:  # of a plant from another source
        return dict(given)
    raise ParameterError(
        f"unknown problem {shown(name)} without an 'equation'; {alike(str(name), shipped)}expected one "
        f"of {', '.join(shipped)}, or the parameters of a problem of your own"
    )


def own_values(given: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of a user's plant, without those that it defines itself and that are not given."""
    if given.get("equation"):
        raise ParameterError(
            f"parameters 'equation' and 'plant' are both given ({given['equation']}, "
            f"{given['plant']}); give one of them"
        )
    return {
        **{k: v for k, v in values.items() if k in given or k not in OF_THE_PLANT},
        "equation": "",
    }


def _physical(given: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of the equation, which are numbers, or of the plant."""
    physical: dict[str, Any] = {}
    for name, value in given.items():
        if name.startswith("physical."):
            value = value.tolist() if hasattr(value, "tolist") else value  # NumPy's
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if given["plant"] and isinstance(value, (bool, int, float, str, list)):
                physical[name] = value
            elif number:
                physical[name] = math.inf if abs(value) >= 2**1000 else float(value)
            else:
                raise ParameterError(
                    f"parameter '{name}' is {shown(value)}; expected a number{exponent_hint(value)}"
                )
    return physical


def code_from(folder: Path, code: str) -> str:
    """The name of code, with a relative file taken from there."""
    if code.startswith(PROCESS):
        return PROCESS + absolute_words(code.removeprefix(PROCESS), folder)
    if code.endswith(FMU):
        return str(folder / code)
    file, colon, name = code.rpartition(":")
    if colon and file.endswith(".py") and not Path(file).is_absolute():
        return f"{folder / file}:{name}"
    return code


def _words(plant: str) -> str:
    """The name of a problem that has no file: path/to/rod.py:HeatedRod is heated-rod."""
    if plant.startswith(PROCESS) or plant.endswith(FMU):
        return _words(f":{Path(plant.split()[-1]).stem}")
    name = plant.rpartition(":")[2].rpartition(".")[2]
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|[^A-Za-z0-9]+", "-", name)
    return words.strip("-").lower() or "plant"
