"""Which plants and controllers serve one tuner: their namespaces, parameters and cores."""

from __future__ import annotations

from dataclasses import dataclass, field

from loop_interfaces.affinity import free_cores
from loop_interfaces.parameters import ParameterError

MAX_PAIRS = 64
"""On one machine; on several, start the pairs by hand (docs/scaling.md)."""


@dataclass(frozen=True)
class PairNode:
    """A plant or a controller: name of its process, package, parameters NAME:=VALUE, remaps."""

    name: str
    package: str
    parameters: list[str] = field(default_factory=list)
    remaps: list[str] = field(default_factory=list)


def namespaces(pairs: int) -> list[str]:
    """Namespaces of the pairs; one alone needs none."""
    return [f"pair{i}" for i in range(pairs)] if pairs > 1 else [""]


def pair_nodes(pairs: int, pin: bool) -> list[PairNode]:
    """The nodes of `pairs` pairs; with `pin` each has a core of its own.

    ParameterError when there are too many for this machine.
    """
    if not 1 <= pairs <= MAX_PAIRS:
        raise ParameterError(f"--pairs is {pairs}; expected a whole number from 1 to {MAX_PAIRS}")
    cores = free_cores(2 * pairs)
    if pin and len(set(cores)) < 2 * pairs:
        raise ParameterError(
            f"--pin gives each of the {2 * pairs} plants and controllers a core of its own, but "
            f"there are {len(set(cores))}; leave out --pin, or use fewer pairs"
        )
    nodes = []
    for number, namespace in enumerate(namespaces(pairs)):
        for place, package in enumerate(("pde_sim_node", "controller_node")):
            parameters = [f"pin:={cores[2 * number + place]}"] if pin else []
            if number and package == "pde_sim_node":  # /clock is one topic for all
                parameters.append("publish_clock:=false")
            remaps = [f"__ns:=/{namespace}"] if namespace else []
            name = f"{package}-{namespace}" if namespace else package
            nodes.append(PairNode(name, package, parameters, remaps))
    return nodes


def tuner_parameter(pairs: int) -> list[str]:
    """What the tuner and the recorder have to know of the pairs."""
    return [f"pairs:=[{', '.join(namespaces(pairs) if pairs > 1 else [quoted('')])}]"]


def quoted(text: object) -> str:
    """A text as a ROS argument: without quotes `5`, `no` or `a: b` would be something else."""
    return "'" + str(text).replace("'", "''") + "'"
