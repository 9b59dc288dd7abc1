# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Problem files, and a problem's resolved parameters. No ROS import."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pdeloop.messages.own_code import FMU, PROCESS, absolute_words
from pdeloop.messages.parameter_file import ParameterFile, read_parameter_file
from pdeloop.messages.parameters import (
    NODES,
    OF_THE_PLANT,
    POINTS,
    PROBLEM,
    table,
    with_budget,
    with_names,
)
from pdeloop.messages.spec import (
    FIELD_MODEL_SETTINGS,
    IDENTIFICATION_SETTINGS,
    LAW_SETTINGS,
    OPTIMIZER_SETTINGS,
    SETTINGS,
    ParameterError,
    check,
    check_names,
    exponent_hint,
)
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


ROS_OWN = ("use_sim_time", "qos_overrides", "start_type_description_service")
"""Parameters of every ROS node, or the beginnings of their names."""
DECLARED_BY = {
    "physical.": "P",
    OPTIMIZER_SETTINGS: "T",
    LAW_SETTINGS: "CT",
    IDENTIFICATION_SETTINGS: "CT",
    FIELD_MODEL_SETTINGS: "CT",
}
"""Letters of the nodes that take the parameters of an equation, a plant or a method."""


def read_problem(path: Path) -> dict[str, Any]:
    """Read the parameters for a loop's nodes, each from the blocks of the nodes that take it.

    They are nodes without a namespace; if the file has nothing for those, of the namespace that it is
    for. ParameterError where that are several, where two nodes are given different values, and where
    the file has nothing for any of them.
    """
    file = read_parameter_file(path)
    own = _for_loop(file, "")
    if own:
        return own
    others = {space: values for space in _namespaces(file) if (values := _for_loop(file, space))}
    views = list(others.values())
    if not views:
        raise ParameterError(nothing_for("the nodes of a loop", [file]))
    if any(view != views[0] for view in views):
        raise ParameterError(
            f"{path} has different parameters for the nodes in {' and in '.join(others)}; use a "
            "separate file for each"
        )
    return views[0]


def nothing_for(whom: str, files: Sequence[ParameterFile]) -> str:
    """Message that these files have nothing for a node, naming the nodes they are for."""
    names = ", ".join(str(file.path) for file in files)
    blocks = [name for file in files for name in file.blocks]
    if not blocks:
        return f"{names} has no parameters; expected '/**:' with 'ros__parameters:' in it"
    return (
        f"{names} has no parameters for {whom}, only for {shown(', '.join(blocks))[1:-1]}; expected "
        "'/**:' or the full name of the node above 'ros__parameters:'"
    )


def of_ros(name: str) -> bool:
    """True for a parameter that every ROS node has."""
    return name.split(".")[0] in ROS_OWN


def _for_loop(file: ParameterFile, namespace: str) -> dict[str, Any]:
    """The parameters for the nodes in a namespace, each from the blocks of the nodes that take it."""
    takers = {spec.name: spec.nodes for spec in table()}
    found: dict[str, tuple[str, Any]] = {}
    for letter, node in NODES.items():
        for name, value in file.of(f"{namespace}/{node}").items():
            free = (who for beginning, who in DECLARED_BY.items() if name.startswith(beginning))
            # An unknown one is kept, to be refused.
            if of_ros(name) or letter not in takers.get(name, next(free, letter)):
                continue
            other, known = found.setdefault(name, (node, value))
            if known is not value and known != value:  # nan differs from itself
                raise ParameterError(
                    f"{file.path} has '{name}' as {shown(known)} for {other} and as {shown(value)} for "
                    f"{node}; expected one value"
                )
    return {name: value for name, (_, value) in found.items()}


def _namespaces(file: ParameterFile) -> list[str]:
    """Namespaces in which there may be nodes that the blocks of a file are for."""
    found = []
    for name in file.blocks:
        outer, _, last = name.removeprefix("/").rpartition("/")
        if last in ("*", "**", *NODES.values()):
            parts = [
                part.replace("*", "any") for part in outer.split("/") if part not in ("", "**")
            ]
            found.append("".join(f"/{part}" for part in parts))
    return list(dict.fromkeys(found))
