"""Plants and controllers of a problem, in a namespace: they serve whichever tuner comes.

ros2 launch pdeloop loop.launch.py problem:=kdv namespace:=lab
ros2 launch pdeloop loop.launch.py --show-args
"""

from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch_ros.actions import Node

from loop_interfaces.isolation import NETWORK
from loop_interfaces.parameters import flags
from loop_interfaces.problem import find_problem, load_parameters, shipped_problems
from pde_sim_node.equations import ALLOWED, allow
from pdeloop.pairs import PAIRS, core_parameters, namespaces, pair_cores
from pdeloop.supervisor import REFUSED

PLANT_FLAGS = [spec for spec in flags() if "P" in spec.nodes]


def generate_launch_description() -> LaunchDescription:
    """Called by launch."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "problem",
                default_value="burgers",
                description=f"a shipped problem ({', '.join(shipped_problems())}) or the path of a "
                "YAML file",
            ),
            DeclareLaunchArgument(
                "namespace", default_value="", description="namespace of all nodes; empty: none"
            ),
            DeclareLaunchArgument("pairs", default_value="1", description=PAIRS.description),
            DeclareLaunchArgument(
                "pin",
                default_value="false",
                choices=["true", "false"],
                description="a core of its own for each pair",
            ),
            DeclareLaunchArgument(
                "equation",
                default_value="",
                description="the plant's PDE; an own one, file.py:Class or package.module:Class, has "
                "to be named here, as a problem's file alone runs no code; empty: the problem's",
            ),
            *(
                DeclareLaunchArgument(
                    spec.name,
                    default_value="",
                    description=f"{spec.description} [{spec.default}, if the problem's file does not "
                    "say otherwise]",
                )
                for spec in PLANT_FLAGS
            ),
            DeclareLaunchArgument(
                "network",
                default_value="false",
                choices=["true", "false"],
                description="let messages leave this machine; false: loopback only",
            ),
            DeclareLaunchArgument(
                "log_level",
                default_value="info",
                choices=["debug", "info", "warn", "error", "fatal"],
                description="least severe messages that are shown",
            ),
            SetEnvironmentVariable("PYTHONUNBUFFERED", "1"),
            RegisterEventHandler(OnProcessExit(on_exit=end_if_refused)),
            OpaqueFunction(function=pairs_of_nodes),
        ]
    )


def pairs_of_nodes(context: LaunchContext) -> list[Any]:
    """A plant and a controller for each pair; several pairs are in pair0, pair1, ..."""
    given = context.launch_configurations
    own = {spec.name: spec.parse(given[spec.name]) for spec in PLANT_FLAGS if given[spec.name]}
    actions: list[Any] = []
    if given["equation"]:
        own["equation"] = allow(given["equation"])
        actions.append(SetEnvironmentVariable(ALLOWED, context.environment[ALLOWED]))
    if given["network"] == "true":
        actions.append(SetEnvironmentVariable(NETWORK, "1"))
    # Read here, too, so that what is wrong is said before a node starts; and because the nodes would
    # look for a relative file of an equation in their working directory.
    own["equation"] = load_parameters(given["problem"], own)["equation"]
    problem = find_problem(given["problem"]).resolve()
    pinned = given["pin"] == "true"
    cores = pair_cores(PAIRS.parse(given["pairs"]), pinned)
    for number, (pair, core) in enumerate(zip(namespaces(len(cores)), cores, strict=True)):
        for executable in ("pde_sim_node", "controller_node"):
            parameters = {**own, **core_parameters(core)}
            if executable == "pde_sim_node":
                parameters["publish_clock"] = number == 0  # /clock is one topic for all
            actions.append(
                Node(
                    package="pdeloop",
                    executable=executable,
                    namespace="/".join(n for n in (given["namespace"].rstrip("/"), pair) if n)
                    or None,
                    parameters=[problem, parameters],
                    ros_arguments=["--log-level", given["log_level"]],
                    output="screen",
                    respawn=True,
                    respawn_delay=1.0,
                )
            )
    return actions


def end_if_refused(event: ProcessExited, context: LaunchContext) -> None:
    """End the launch, with an error, when a node refuses its parameters; it has said why."""
    if event.returncode == REFUSED and not context.is_shutdown:
        raise RuntimeError(f"{event.process_name} refuses to run; its last words are above")
