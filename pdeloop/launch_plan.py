"""What the launch files of this package start: their arguments, and the nodes that follow.

Without ROS; pdeloop.launch_actions makes actions of it, and launch/*.launch.py are the files.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from loop_interfaces.isolation import NETWORK
from loop_interfaces.parameters import INSTRUMENTS, PLANT, RECORDER, TUNER
from loop_interfaces.problem import find_problem, load_parameters, shipped_problems
from loop_interfaces.spec import ParameterError, Spec
from pde_sim_node.equations import ALLOWED, allow
from pdeloop.pairs import (
    MAX_PAIRS,
    Layout,
    LoopNode,
    Recording,
    check_pairs,
    pair_cores,
    pair_nodes,
    quoted,
)
from pdeloop.training_run import begin, reopen, unused

_KNOWN = {spec.name: spec for spec in (*INSTRUMENTS, *PLANT, *TUNER, *RECORDER)}


@dataclass(frozen=True)
class Argument:
    """An argument of a launch file; `given_by_problem`: empty means what the problem's file says."""

    spec: Spec
    given_by_problem: bool = False

    @property
    def default(self) -> str:
        """As a launch file shows it."""
        return "" if self.given_by_problem else _text(self.spec.default)

    @property
    def description(self) -> str:
        """What it means, with its unit and what an empty one stands for."""
        spec = self.spec
        unit = f" ({spec.unit})" if spec.unit else ""
        empty = f" [{_text(spec.default)}, if the problem's file does not say otherwise]"
        return f"{spec.description}{unit}{empty * self.given_by_problem}"

    @property
    def choices(self) -> tuple[str, ...]:
        """The words it may be; none: not a matter of words."""
        words = ("true", "false") if self.spec.type is bool else self.spec.choices
        return (*words, "") if words and self.given_by_problem else words

    def value(self, text: str) -> Any:
        """The value of its text, None if it is left to the problem; ParameterError if it is bad."""
        if not text and self.given_by_problem:
            return None
        kinds: dict[type, Callable[[str], Any]] = {bool: _true_or_false, int: int, float: float}
        try:
            value = kinds.get(self.spec.type, str)(text)
        except ValueError:
            value = text
        return self.spec.check(value)


_PLANT = ("real_time_factor", *(spec.name for spec in INSTRUMENTS))
LOOP_ARGUMENTS = (
    Argument(
        Spec(
            "problem",
            "burgers",
            f"a shipped problem ({', '.join(shipped_problems())}) or the path of a YAML file",
        )
    ),
    Argument(Spec("namespace", "", "namespace of all nodes; empty: none")),
    Argument(Spec("pairs", 1, "plants with a controller each", 1, MAX_PAIRS)),
    Argument(
        Spec("pin", False, "a core of its own for each pair, helpers look for work all the time")
    ),
    Argument(
        Spec(
            "equation",
            "",
            "the plant's PDE; an own one, file.py:Class or package.module:Class, has to be named "
            "here, as a problem's file alone runs no code; empty: the problem's",
        )
    ),
    *(Argument(_KNOWN[name], given_by_problem=True) for name in _PLANT),
    Argument(Spec("network", False, "let messages leave this machine; false: loopback only")),
    Argument(
        Spec(
            "log_level",
            "info",
            "least severe messages that are shown",
            choices=("debug", "info", "warn", "error", "fatal"),
        )
    ),
)
"""Arguments of loop.launch.py."""

_TRAINING = (
    "rollouts",
    "iterations",
    "seed",
    "seeds",
    "start",
    "optimizer",
    "directions",
)
TRAIN_ARGUMENTS = (
    *LOOP_ARGUMENTS,
    *(Argument(_KNOWN[name], given_by_problem=True) for name in _TRAINING),
    Argument(Spec("model", "", "start from this model of pdeloop identify; empty: identify one")),
    Argument(Spec("out", "", "new folder of the results; empty: runs/PROBLEM-TIME")),
    Argument(Spec("resume", "", "folder of an interrupted run to continue; empty: a new run")),
    Argument(Spec("record", False, "record all topics to a rosbag2 bag in the folder")),
    Argument(Spec("record_or_stop", False, "as record, and end if the recording fails")),
    Argument(_KNOWN["bag_storage"]),
    Argument(_KNOWN["bag_per_episode"]),
    Argument(Spec("view", False, "a viewer_node, for RViz, Foxglove and PlotJuggler")),
)
"""Arguments of train.launch.py."""


@dataclass(frozen=True)
class Plan:
    """The nodes to start; folder: of the training, where there is one."""

    nodes: list[LoopNode]
    parameter_file: Path
    namespace: str
    log_level: str
    environment: dict[str, str] = field(default_factory=dict)
    folder: Path | None = None


def loop_plan(texts: Mapping[str, str]) -> Plan:
    """Plants and controllers of a problem, which serve whichever tuner comes."""
    given = _values(LOOP_ARGUMENTS, texts)
    own = _plant_parameters(given)
    resolved = load_parameters(given["problem"], own)
    # The nodes would look for a relative file of an equation in their working directory.
    own["equation"] = quoted(resolved["equation"])
    more = [f"{name}:={value}" for name, value in own.items()]
    placement = "pinned" if given["pin"] else "shared"
    nodes = [
        LoopNode(n.name, n.package, [*n.parameters, *more], n.remaps, n.namespace)
        for n in pair_nodes(pair_cores(given["pairs"], placement), solver_polls=given["pin"])
    ]
    return _plan(nodes, find_problem(given["problem"]).resolve(), given)


def train_plan(texts: Mapping[str, str]) -> Plan:
    """A training, in a folder that is made now; ValueError says what cannot be done."""
    given = _values(TRAIN_ARGUMENTS, texts)
    recording = None
    if given["record"] or given["record_or_stop"]:
        recording = Recording(
            given["bag_storage"], given["bag_per_episode"], given["record_or_stop"]
        )
    own = {name: given[name] for name in _TRAINING if given[name] is not None}
    own |= _plant_parameters(given)
    if given["model"]:
        own["model"] = str(Path(given["model"]).resolve())
    layout = Layout(
        given["pairs"], "pinned" if given["pin"] else "shared", recording, view=given["view"]
    )
    check_pairs(layout.pairs, layout.placement)  # refuses before there is a folder
    if given["resume"]:
        changes = [name for name in own if name != "equation"] + ["out"] * bool(given["out"])
        if changes:
            names = ", ".join(changes)
            raise ParameterError(
                f"resume:={given['resume']} continues a run with its own parameters; "
                f"leave out {names}"
            )
        folder = Path(given["resume"])
        reopen(folder)
    else:
        folder, _ = begin(given["problem"], own, Path(given["out"]) if given["out"] else None)
    folder = folder.resolve()
    nodes = layout.nodes(folder, unused(folder / "bag"))
    return _plan(nodes, folder / "parameters.yaml", given, folder)


def _plan(
    nodes: list[LoopNode], file: Path, given: Mapping[str, Any], folder: Path | None = None
) -> Plan:
    environment = {NETWORK: "1"} if given["network"] else {}
    if given["equation"]:
        environment[ALLOWED] = os.environ[ALLOWED]  # as `allow` has left it
    return Plan(nodes, file, given["namespace"], given["log_level"], environment, folder)


def _plant_parameters(given: Mapping[str, Any]) -> dict[str, Any]:
    own = {name: given[name] for name in _PLANT if given[name] is not None}
    return own | ({"equation": allow(given["equation"])} if given["equation"] else {})


def _values(arguments: Iterable[Argument], texts: Mapping[str, str]) -> dict[str, Any]:
    return {a.spec.name: a.value(texts.get(a.spec.name, a.default)) for a in arguments}


def _true_or_false(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError(text)
    return text.lower() == "true"


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
