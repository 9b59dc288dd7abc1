# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training: plants, controllers, the tuner and, if asked for, a recorder. Ends with the tuner.

ros2 launch pdeloop train.launch.py problem:=burgers record:=true pairs:=2
ros2 launch pdeloop train.launch.py --show-args
"""

from pathlib import Path
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    Shutdown,
)
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import Node

from pde_sim_node.equations import OWN_EQUATIONS
from pde_sim_node.plants.loading import OWN_PLANTS
from pdeloop.messages.parameters import LAW, flags
from pdeloop.messages.protocol import STOPPED
from pdeloop.messages.spec import ParameterError, assignment
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from pdeloop.method.laws.registry import OWN_LAWS
from pdeloop.pairs import PAIR, PAIRS, RECORD_EVERY, Transport
from pdeloop.supervisor import RECORDER_GRACE
from pdeloop.training_run import begin, reopen, unused

OWN_CODE = (OWN_EQUATIONS, OWN_PLANTS, OWN_OPTIMIZERS, OWN_LAWS)
LOOP = Path(__file__).parent / "loop.launch.py"
FLAGS = flags()
ARGUMENTS = {
    # Those of the plant, and the law, are arguments of the loop.
    **{
        s.name: ("", f"{s.description} [the problem's]")
        for s in FLAGS
        if "P" not in s.nodes and s is not LAW
    },
    "set": ("", "other parameters, as for pdeloop train --set: NAME=VALUE,NAME=VALUE"),
    "model": ("", "start from this model of pdeloop identify; empty: identify one"),
    "out": ("", "new folder of the results; empty: runs/PROBLEM-TIME"),
    "resume": ("", "folder of an interrupted run to continue; empty: a new run"),
    "record": ("false", "true: record all topics to a rosbag2 bag in the folder"),
    "record_or_stop": ("false", "true: like record, but stop the training if the recording fails"),
    "record_every": ("1", "record only the states of every N-th step"),
    "view": ("false", "true: also start a viewer_node, for RViz, Foxglove and PlotJuggler"),
}
"""Defaults and meanings."""
ENDED = (0, 130, STOPPED)
"""Exit codes of a tuner that is done, was interrupted, or was stopped on request."""


def generate_launch_description() -> LaunchDescription:
    """Called by launch."""
    loop = PythonLaunchDescriptionSource(str(LOOP))
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(
                    name,
                    default_value=default,
                    description=meaning,
                    choices=["true", "false"] if default == "false" else None,
                )
                for name, (default, meaning) in ARGUMENTS.items()
            ),
            *loop.get_launch_description(LaunchContext()).get_launch_arguments(),
            OpaqueFunction(function=training),
        ]
    )


def training(context: LaunchContext) -> list[Any]:
    """Begin or continue a run in its folder, and start its nodes."""
    given = context.launch_configurations
    on = {name for name in ("record", "record_or_stop", "view") if given[name] == "true"}
    required, recorded = "record_or_stop" in on, bool(on & {"record", "record_or_stop"})
    transport = Transport(
        recorder="required" if required else "start" if recorded else "none",
        record_every=RECORD_EVERY.parse(given["record_every"]),
        pairs=PAIRS.parse(given["pairs"]),
        view="view" in on,
    )
    folder = run_folder(given, transport)
    given["problem"] = str(folder / "parameters.yaml")
    actions: list[Any] = [LogInfo(msg=f"training in {folder}")]
    for kind in (OWN_OPTIMIZERS, OWN_LAWS):
        if given[kind.word]:
            allowed = context.environment[kind.variable]
            actions.append(SetEnvironmentVariable(kind.variable, allowed))
    for node in transport.nodes(folder):
        if node.package in PAIR:
            continue  # of the loop
        options: dict[str, Any] = {"respawn": True, "respawn_delay": 1.0}
        if node.package == "recorder_node":  # not started again: it has a bag to finish
            node = node.having(bag=str(unused(folder / "bag")))
            grace = str(RECORDER_GRACE)
            options = {"sigterm_timeout": grace, "sigkill_timeout": grace}
        action = Node(
            package="pdeloop",
            executable=node.package,
            namespace=node.namespace_in(given["namespace"]),
            # Not as `parameters`: launch_ros leaves a file for each dictionary in the temporary folder.
            ros_arguments=[
                "--log-level",
                given["log_level"],
                *node.parameter_arguments(folder / "parameters.yaml"),
            ],
            output="screen",
            **options,
        )
        actions.append(action)
    ended = OnProcessExit(target_action=action, on_exit=end_with_tuner)  # the tuner is the last
    loop = IncludeLaunchDescription(PythonLaunchDescriptionSource(str(LOOP)))
    return [*actions, RegisterEventHandler(ended), loop]


def run_folder(given: dict[str, str], transport: Transport) -> Path:
    """The folder of the run: a new one, or that of the run to continue."""
    own: dict[str, Any] = {s.name: s.parse(given[s.name]) for s in FLAGS if given[s.name]}
    own |= dict(assignment(text) for text in filter(None, given["set"].split(",")))
    if given["model"]:
        own["model"] = str(Path(given["model"]).resolve())
    kinds = [kind for kind in OWN_CODE if given[kind.word]]
    code = {kind.word: kind.allow(given[kind.word]) for kind in kinds}
    if given["resume"]:
        for word in own.keys() & code.keys():
            if ":" in code[word]:  # code of a run has to be named again
                del own[word]
        if own or given["out"]:
            names = ", ".join([*own, *["out"] * bool(given["out"])])
            raise ParameterError(
                f"resume:={given['resume']} continues a run with its own parameters; leave out {names}"
            )
        reopen(Path(given["resume"]))
        return Path(given["resume"]).resolve()
    out = Path(given["out"]) if given["out"] else None
    return begin(given["problem"], {**own, **code}, out, transport)[0].resolve()


def end_with_tuner(event: ProcessExited, context: LaunchContext) -> list[Any]:
    """The launch is over when the training is."""
    return [Shutdown(reason="the training is over")] if event.returncode in ENDED else []
