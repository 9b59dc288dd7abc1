# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The nodes of a run: which plants and controllers serve one tuner, and their parameters.

`pdeloop train` starts them as processes (pdeloop.supervisor); `ros2 launch` by the files in launch/.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pde_sim_node.build import fingerprint
from pdeloop.domain import given_domain
from pdeloop.messages.parameters import taken_by
from pdeloop.messages.spec import ParameterError, Spec
from pdeloop.process.affinity import least_busy_cores, usable_cores
from pdeloop.process.isolation import NETWORK, PROFILE
from pdeloop.process.ros_environment import prepared, with_servers_there
from pdeloop.supervisor import NodeError
from tuner_node.run_folder import RunFolder

MAX_PAIRS = 64
"""On one machine; on several, start the pairs by hand (docs/scaling.md)."""
PAIRS = Spec("pairs", 1, 1, MAX_PAIRS).means("plants with a controller each")
"""Number of pairs that a command or a launch file starts."""
RECORD_EVERY = next(spec for spec in taken_by("recorder_node") if spec.name == "state_every")
"""Of the states of how many steps one is recorded."""


@dataclass(frozen=True)
class LoopNode:
    """A node of a run: name of its process, package, and parameters other than those of the problem.

    namespace: relative to that of the run, empty: the run's own; cores: those that all its threads
    may use, empty: any.
    """

    name: str
    package: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    namespace: str = ""
    cores: Sequence[int] = ()

    @property
    def assignments(self) -> list[str]:
        """Its parameters as NAME:=VALUE."""
        return [f"{name}:={ros_value(value)}" for name, value in self.parameters.items()]

    def namespace_in(self, outer: str) -> str | None:
        """Its namespace where that of the run is `outer`, as a launch file takes it.

        >>> LoopNode("plant", "pde_sim_node", namespace="pair1").namespace_in("lab")
        'lab/pair1'
        """
        return "/".join(name for name in (outer.rstrip("/"), self.namespace) if name) or None

    def having(self, **parameters: Any) -> LoopNode:
        """The same node with these parameters."""
        return replace(self, parameters={**self.parameters, **parameters})

    def without_recorder(self) -> LoopNode:
        """The same node where the recorder has ended: only a tuner that requires one waits for it."""
        return self.having(recorder="none") if self.parameters.get("recorder") == "start" else self

    def parameter_arguments(self, parameter_file: Path) -> list[str]:
        """The arguments after `--ros-args` that give it the file's parameters, then its own."""
        words = ["--params-file", str(parameter_file)]
        for assignment in self.assignments:
            words += ["-p", assignment]
        return words

    def ros_arguments(self, parameter_file: Path) -> list[str]:
        """All that follows `--ros-args` in its command."""
        words = self.parameter_arguments(parameter_file)
        return [*words, "-r", f"__ns:=/{self.namespace}"] if self.namespace else words


PAIR = ("pde_sim_node", "controller_node")
"""The packages of a pair's nodes."""


def namespaces(pairs: int) -> list[str]:
    """Namespaces of the pairs; one alone needs none."""
    return [f"pair{i}" for i in range(pairs)] if pairs > 1 else [""]


def pair_cores(pairs: int) -> list[int | None]:
    """The core that plant and controller of each pair share, the least busy ones first; None: any.

    They take turns, so that a message on one core wakes no idle one. On a machine with a single core
    there is nothing to choose.
    """
    if len(usable_cores()) == 1 or not hasattr(os, "sched_setaffinity"):
        return [None] * pairs
    return list(least_busy_cores(pairs))


def pair_nodes(cores: Sequence[int | None]) -> list[LoopNode]:
    """The nodes of as many pairs as there are `cores` (see `pair_cores`)."""
    nodes = []
    for number, (namespace, core) in enumerate(zip(namespaces(len(cores)), cores, strict=True)):
        for package in PAIR:
            own: dict[str, Any] = {} if core is None else {"pin": core}
            if number and package == "pde_sim_node":
                own["publish_clock"] = False  # /clock is one topic for all
            name = f"{package}-{namespace}" if namespace else package
            nodes.append(LoopNode(name, package, own, namespace))
    return nodes


@dataclass(frozen=True)
class Transport:
    """The execution of a training; nothing of this changes its results.

    in_process: without ROS; recorder: as the tuner's parameter says it; record_every: steps from one
    state that is recorded to the next; network: let the messages leave this machine; pairs: of plant
    and controller; view: with a viewer_node of the first pair.
    """

    in_process: bool = False
    recorder: str = "none"
    record_every: int = 1
    network: bool = False
    pairs: int = 1
    view: bool = False

    def __post_init__(self) -> None:
        if self.record_every > 1 and not self.recorded:
            raise ParameterError("--record-every needs a recording; give --record as well")
        if self.in_process and (self.recorded or self.network):
            raise ParameterError(
                "--record and --network apply to topics only; leave out --in-process"
            )
        if self.network and os.environ.get(PROFILE):
            raise ParameterError(
                f"--network and {PROFILE}={os.environ[PROFILE]} both say where messages go; leave "
                "out --network to use that profile, or unset the variable"
            )
        if self.in_process and (self.pairs > 1 or self.view):
            raise ParameterError("--pairs and --view apply to nodes only; leave out --in-process")
        PAIRS.check(self.pairs)
        RECORD_EVERY.check(self.record_every)

    def require(self) -> None:
        """Refuse what would end the nodes: no ROS, a wrong ROS domain."""
        if self.in_process:
            return
        if importlib.util.find_spec("rclpy") is None:
            raise NodeError(
                "needs rclpy: source an installed ROS 2 Jazzy, or pip install 'pdeloop[ros]', or train "
                "without ROS: --in-process"
            )
        given_domain()
        self.environment()

    def environment(self) -> tuple[dict[str, str], list[str]]:
        """The environment of the nodes, and what is left out of this one's, in words.

        RosEnvironmentError where no node could work.
        """
        found, remarks = prepared({**os.environ, **({NETWORK: "1"} if self.network else {})})
        found, more = with_servers_there(found)
        return found, remarks + more

    @property
    def words(self) -> list[str]:
        """The flags of `pdeloop train` that ask for it.

        >>> Transport(recorder="required", pairs=2).words
        ['--record-or-stop', '--pairs', '2']
        """
        recorder = {"start": "--record", "required": "--record-or-stop"}.get(self.recorder)
        numbers = {"--record-every": self.record_every, "--pairs": self.pairs}
        flags = {"--in-process": self.in_process, "--network": self.network, "--view": self.view}
        return [
            *([recorder] if recorder else []),
            *(word for flag, n in numbers.items() if n > 1 for word in (flag, str(n))),
            *(flag for flag, given in flags.items() if given),
        ]

    @property
    def recorded(self) -> bool:
        """True if there is a recorder."""
        return self.recorder != "none"

    def nodes(self, folder: Path) -> list[LoopNode]:
        """The nodes of the training in `folder`, a run that was begun (RunFolder.create).

        The recorder, if any, comes first, and receives its bag when it is started. Recorder and viewer
        leave the cores of the pairs to them, if there are others.
        """
        serving = {"pairs": namespaces(self.pairs)}
        cores = pair_cores(self.pairs)
        nodes = pair_nodes(cores)
        others = tuple(core for core in usable_cores() if core not in cores)
        if self.view:
            first = namespaces(self.pairs)[0]
            nodes.append(LoopNode("viewer_node", "viewer_node", namespace=first, cores=others))
        if self.recorded:
            own = {**serving, "state_every": self.record_every}
            nodes.insert(0, LoopNode("recorder_node", "recorder_node", own, cores=others))
        tuner = {
            **serving,
            "out": str(folder.resolve()),
            "resume": True,  # so that a restarted one continues where it was
            "recorder": self.recorder,
            "plant_fingerprint": fingerprint(RunFolder(folder).values()),
        }
        return [*nodes, LoopNode("tuner_node", "tuner_node", tuner)]


def ros_value(value: object) -> str:
    """A value as a ROS argument; without quotes `5`, `no` or `a: b` would be something else."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(ros_value, value))}]"
    return "'" + value.replace("'", "''") + "'" if isinstance(value, str) else str(value)
