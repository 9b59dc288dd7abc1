"""The nodes of a run: which plants and controllers serve one tuner, and what each is told.

`pdeloop train` starts them as processes (pdeloop.supervisor); `ros2 launch` by the files in launch/.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loop_interfaces.affinity import core_text, least_busy_cores, usable_cores
from loop_interfaces.isolation import PROFILE
from loop_interfaces.spec import ParameterError, Spec
from pde_sim_node.build import fingerprint
from tuner_node.results import RunFolder

MAX_PAIRS = 64
"""On one machine; on several, start the pairs by hand (docs/scaling.md)."""
PAIRS = Spec("pairs", 1, 1, MAX_PAIRS).means("plants with a controller each")
"""How many pairs a command or a launch file starts."""
PLACEMENTS = ("shared", "pinned", "any")
"""Where plant and controller of a pair run, for good: on one core for both, which they take in turns,
so that a message wakes no idle core; the same, with a core for each pair and the plant's helpers
polling on the others; or wherever the scheduler puts them."""


@dataclass(frozen=True)
class LoopNode:
    """A node of a run.

    Attributes
    ----------
    name : str
        Of its process.
    package : str
    parameters : sequence of str
        As NAME:=VALUE.
    namespace : str
        Relative to that of the run; empty: the run's own.
    cores : sequence of int
        The cores that all its threads may use; empty: any.
    """

    name: str
    package: str
    parameters: Sequence[str] = ()
    namespace: str = ""
    cores: Sequence[int] = ()

    def ros_arguments(self, parameter_file: Path) -> list[str]:
        """All that follows `--ros-args` in its command."""
        words = ["--params-file", str(parameter_file)]
        for value in self.parameters:
            words += ["-p", value]
        return [*words, "-r", f"__ns:=/{self.namespace}"] if self.namespace else words


PAIR = ("pde_sim_node", "controller_node")
"""The packages of a pair's nodes."""


@dataclass(frozen=True)
class Recording:
    """How a run is recorded; required: it stops if the recorder does; views: with a viewer's topics."""

    required: bool = False
    views: bool = False


def namespaces(pairs: int) -> list[str]:
    """Namespaces of the pairs; one alone needs none."""
    return [f"pair{i}" for i in range(pairs)] if pairs > 1 else [""]


def check_pairs(pairs: int, placement: str = "shared") -> None:
    """ParameterError when there are too many pairs for this machine."""
    if not 1 <= pairs <= MAX_PAIRS:
        raise ParameterError(f"--pairs is {pairs}; expected a whole number from 1 to {MAX_PAIRS}")
    cores = len(usable_cores())
    if placement == "pinned" and cores < pairs:
        raise ParameterError(
            f"--pin gives each of the {pairs} pairs of plant and controller a core of its own, but "
            f"there are {cores}; leave out --pin, or use fewer pairs"
        )


def pair_cores(pairs: int, placement: str) -> list[int | None]:
    """The core that each pair shares, the least busy ones first; None: any."""
    check_pairs(pairs, placement)
    choice = len(usable_cores()) > 1 and hasattr(os, "sched_setaffinity")
    if placement == "any" or not (choice or placement == "pinned"):
        return [None] * pairs
    return list(least_busy_cores(pairs))


def core_parameters(package: str, core: int | None, *, solver_polls: bool) -> dict[str, Any]:
    """What keeps a node of a pair on its core, and the plant's helpers on all."""
    if core is None:
        return {}
    solver = {"solver_cores": core_text(usable_cores()), "solver_polls": solver_polls}
    return {"pin": core, **(solver if package == "pde_sim_node" else {})}


def pair_nodes(cores: Sequence[int | None], *, solver_polls: bool = False) -> list[LoopNode]:
    """The nodes of as many pairs as there are `cores` (see `pair_cores`).

    solver_polls: the plant's helpers look for work all the time.
    """
    nodes = []
    for number, (namespace, core) in enumerate(zip(namespaces(len(cores)), cores, strict=True)):
        for package in PAIR:
            own = core_parameters(package, core, solver_polls=solver_polls)
            parameters = [f"{name}:={argument(value)}" for name, value in own.items()]
            if number and package == "pde_sim_node":  # /clock is one topic for all
                parameters.append("publish_clock:=false")
            name = f"{package}-{namespace}" if namespace else package
            nodes.append(LoopNode(name, package, parameters, namespace))
    return nodes


@dataclass(frozen=True)
class Transport:
    """How a training is carried out; nothing of this changes its results.

    Attributes
    ----------
    in_process : bool
        Without ROS.
    recording : Recording, optional
        How it is recorded; None: not at all.
    network : bool
        Let the messages leave this machine.
    pairs : int
        Of plant and controller.
    pin : bool
        Keep each pair on a core of its own, and its solver's helpers polling.
    view : bool
        With a viewer_node of the first pair.
    spread : bool
        Leave the cores to the scheduler (PLACEMENTS).
    """

    in_process: bool = False
    recording: Recording | None = None
    network: bool = False
    pairs: int = 1
    pin: bool = False
    view: bool = False
    spread: bool = False

    def __post_init__(self) -> None:
        if self.in_process and (self.recording or self.network):
            raise ParameterError("--record and --network are about topics; leave out --in-process")
        if self.network and os.environ.get(PROFILE):
            raise ParameterError(
                f"--network and {PROFILE}={os.environ[PROFILE]} both say where messages go; leave "
                "out --network to use that profile, or unset the variable"
            )
        if self.in_process and (self.pairs > 1 or self.pin or self.spread or self.view):
            raise ParameterError(
                "--pairs, --pin, --spread and --view are about nodes; leave out --in-process"
            )
        if self.pin and self.spread:
            raise ParameterError(
                "--pin keeps each pair on a core, --spread on none; leave out one of them"
            )
        check_pairs(self.pairs, self.placement)

    @property
    def placement(self) -> str:
        """One of PLACEMENTS."""
        return "pinned" if self.pin else "any" if self.spread else "shared"

    def nodes(self, folder: Path) -> list[LoopNode]:
        """The nodes of the training in `folder`, a run that was begun (RunFolder.create).

        The recorder, if any, comes first; it is told its bag when it is started. Recorder and viewer
        leave the cores of the pairs to them, if there are others.
        """
        recording, serving = self.recording, tuner_parameter(self.pairs)
        cores = pair_cores(self.pairs, self.placement)
        nodes = pair_nodes(cores, solver_polls=self.pin)
        others = tuple(core for core in usable_cores() if core not in cores)
        if self.view or (recording is not None and recording.views):
            first = namespaces(self.pairs)[0]
            nodes.append(LoopNode("viewer_node", "viewer_node", namespace=first, cores=others))
        wait = "none"
        if recording is not None:
            wait = "required" if recording.required else "start"
            own = [*serving, *["record_views:=true"] * recording.views]
            nodes.insert(0, LoopNode("recorder_node", "recorder_node", own, cores=others))
        # resume: one that is started again goes on where it was.
        tuner = [f"out:={quoted(folder.resolve())}", "resume:=true", f"recorder:={wait}", *serving]
        tuner.append(f"plant:={fingerprint(RunFolder(folder).values())}")
        return [*nodes, LoopNode("tuner_node", "tuner_node", tuner)]


def tuner_parameter(pairs: int) -> list[str]:
    """What the tuner and the recorder have to know of the pairs."""
    return [f"pairs:=[{', '.join(namespaces(pairs) if pairs > 1 else [quoted('')])}]"]


def argument(value: object) -> str:
    """A value as a ROS argument."""
    if isinstance(value, bool):
        return str(value).lower()
    return quoted(value) if isinstance(value, str) else str(value)


def quoted(text: object) -> str:
    """A text as a ROS argument: without quotes `5`, `no` or `a: b` would be something else."""
    return "'" + str(text).replace("'", "''") + "'"
