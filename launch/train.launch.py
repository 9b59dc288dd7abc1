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
    Shutdown,
)
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import Node

from loop_interfaces.parameters import flags
from loop_interfaces.protocol import STOPPED
from loop_interfaces.spec import ParameterError
from pde_sim_node.build import fingerprint
from pde_sim_node.equations import allow
from pdeloop.pairs import PAIRS, check_pairs, namespaces
from pdeloop.supervisor import RECORDER_GRACE
from pdeloop.training_run import begin, reopen, unused

LOOP = Path(__file__).parent / "loop.launch.py"
FLAGS = flags()
ENDED = (0, 130, STOPPED)
"""Exit codes of a tuner that is done, was interrupted, or was stopped on request."""


def generate_launch_description() -> LaunchDescription:
    """Called by launch."""
    loop = PythonLaunchDescriptionSource(str(LOOP))
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(
                    spec.name,
                    default_value="",
                    description=f"{spec.description} [{spec.default}, if the problem's file does not "
                    "say otherwise]",
                    choices=[*spec.choices, ""] if spec.choices else None,
                )
                for spec in FLAGS
                if "P" not in spec.nodes  # these are arguments of the loop
            ),
            *(
                DeclareLaunchArgument(name, default_value="", description=description)
                for name, description in (
                    ("model", "start from this model of pdeloop identify; empty: identify one"),
                    ("out", "new folder of the results; empty: runs/PROBLEM-TIME"),
                    ("resume", "folder of an interrupted run to continue; empty: a new run"),
                )
            ),
            *(
                DeclareLaunchArgument(
                    name, default_value="false", choices=["true", "false"], description=description
                )
                for name, description in (
                    ("record", "record all topics to a rosbag2 bag in the folder"),
                    ("record_or_stop", "as record, and end if the recording fails"),
                    ("view", "a viewer_node, for RViz, Foxglove and PlotJuggler"),
                )
            ),
            *loop.get_launch_description(LaunchContext()).get_launch_arguments(),
            OpaqueFunction(function=training),
        ]
    )


def training(context: LaunchContext) -> list[Any]:
    """Begin a run, or go on with one, in its folder, and start the nodes for it."""
    given = context.launch_configurations
    pairs = PAIRS.parse(given["pairs"])
    check_pairs(pairs, given["pin"] == "true")
    own = {spec.name: spec.parse(given[spec.name]) for spec in FLAGS if given[spec.name]}
    if given["model"]:
        own["model"] = str(Path(given["model"]).resolve())
    equation = {"equation": allow(given["equation"])} if given["equation"] else {}
    if given["resume"]:
        if own or given["out"]:
            names = ", ".join([*own, *["out"] * bool(given["out"])])
            raise ParameterError(
                f"resume:={given['resume']} continues a run with its own parameters; leave out {names}"
            )
        folder = Path(given["resume"]).resolve()
        values = reopen(folder)
    else:
        out = Path(given["out"]).resolve() if given["out"] else None
        folder, values = begin(given["problem"], {**own, **equation}, out)
        folder = folder.resolve()
    context.launch_configurations["problem"] = str(folder / "parameters.yaml")

    def node(executable: str, namespace: str = "", **options: Any) -> Node:
        more = options.pop("parameters", {})
        return Node(
            package="pdeloop",
            executable=executable,
            namespace="/".join(n for n in (given["namespace"].rstrip("/"), namespace) if n) or None,
            parameters=[folder / "parameters.yaml", more],
            ros_arguments=["--log-level", given["log_level"]],
            output="screen",
            **options,
        )

    required = given["record_or_stop"] == "true"
    recorded = required or given["record"] == "true"
    serving = {"pairs": namespaces(pairs)}
    tuner = node(
        "tuner_node",
        parameters={
            **serving,
            "out": str(folder),
            "resume": True,  # so that a tuner that is started again goes on where it was
            "plant": fingerprint(values),
            "recorder": "required" if required else "start" if recorded else "none",
        },
        respawn=True,
        respawn_delay=1.0,
    )
    actions = [
        LogInfo(msg=f"training in {folder}"),
        IncludeLaunchDescription(PythonLaunchDescriptionSource(str(LOOP))),
        tuner,
        RegisterEventHandler(OnProcessExit(target_action=tuner, on_exit=end_with_tuner)),
    ]
    if recorded:
        grace = str(RECORDER_GRACE)  # it has a bag to finish
        bag = {"bag": str(unused(folder / "bag")), **serving}
        recorder = node(
            "recorder_node", parameters=bag, sigterm_timeout=grace, sigkill_timeout=grace
        )
        actions.insert(1, recorder)
    if given["view"] == "true":
        actions.append(node("viewer_node", namespaces(pairs)[0], respawn=True))
    return actions


def end_with_tuner(event: ProcessExited, context: LaunchContext) -> list[Any]:
    """The launch is over when the training is."""
    return [Shutdown(reason="the training is over")] if event.returncode in ENDED else []
