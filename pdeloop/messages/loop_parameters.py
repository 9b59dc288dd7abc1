# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The parameters for a loop's nodes in a parameter file. No ROS import."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pdeloop.messages.parameter_file import ParameterFile, read_parameter_file
from pdeloop.messages.parameters import NODES, table
from pdeloop.messages.spec import (
    FIELD_MODEL_SETTINGS,
    IDENTIFICATION_SETTINGS,
    LAW_SETTINGS,
    OPTIMIZER_SETTINGS,
    ParameterError,
)
from pdeloop.messages.text import shown

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
