# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants and controllers of a problem, in a namespace: they serve whichever tuner comes.

ros2 launch pdeloop loop.launch.py problem:=kdv namespace:=lab
ros2 launch pdeloop loop.launch.py --show-args
"""

from dataclasses import replace
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

from pde_sim_node.build import complete
from pde_sim_node.equations import OWN_EQUATIONS
from pde_sim_node.plants.loading import OWN_PLANTS
from pdeloop.messages.parameters import OF_THE_PLANT, flags
from pdeloop.messages.problem import find_problem, load_parameters, read_problem, shipped_problems
from pdeloop.method.laws.registry import OWN_LAWS
from pdeloop.pairs import PAIRS, pair_cores, pair_nodes
from pdeloop.process.isolation import NETWORK
from pdeloop.supervisor import REFUSED

PLANT_FLAGS = [spec for spec in flags() if "P" in spec.nodes]
ARGUMENTS = {
    "problem": ("burgers", f"one of {', '.join(shipped_problems())}, or the path of a YAML file"),
    "namespace": ("", "namespace of all nodes; empty: none"),
    "pairs": ("1", PAIRS.description),
    "equation": ("", "the problem's PDE; your own code (file.py:Class) must also be named here"),
    "plant": (
        "",
        "a plant instead of an equation; your own code (file.py:Class) must also be named here",
    ),
    "law": ("", "the control law; your own code (file.py:Class) must also be named here"),
    **{spec.name: ("", f"{spec.description} [the problem's]") for spec in PLANT_FLAGS},
    "network": ("false", "true: let messages leave this machine; false: loopback only"),
    "log_level": ("info", "lowest severity of the messages that are shown"),
}
"""Defaults and meanings."""


def generate_launch_description() -> LaunchDescription:
    """Called by launch."""
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
    for kind in (OWN_EQUATIONS, OWN_PLANTS, OWN_LAWS):
        if given[kind.word]:
            own[kind.word] = kind.allow(given[kind.word])
            allowed = context.environment[kind.variable]
            actions.append(SetEnvironmentVariable(kind.variable, allowed))
    if given["network"] == "true":
        actions.append(SetEnvironmentVariable(NETWORK, "1"))
    # Also read here, so that errors appear before a node starts, and because the nodes would
    # look for a relative file of an equation or a law in their working directory.
    values = load_parameters(given["problem"], own)
    own |= {code: values[code] for code in ("equation", "law")}
    if values["plant"]:  # the other nodes also need what the plant fills in
        _, values = complete(values)
        filled = {name: values[name] for name in ("plant", *OF_THE_PLANT)}
        # The type of an empty list cannot be told.
        own |= {name: value for name, value in filled.items() if value != []}
    problem = find_problem(given["problem"]).resolve()
    in_file = read_problem(problem)
    own = {name: value for name, value in own.items() if value != in_file.get(name)}
    nodes = pair_nodes(pair_cores(PAIRS.parse(given["pairs"])))
    nodes = [replace(node, parameters={**own, **node.parameters}) for node in nodes]
    return actions + [
        Node(
            package="pdeloop",
            executable=node.package,
            namespace=node.namespace_in(given["namespace"]),
            # Not as `parameters`: launch_ros leaves a file for each dictionary in the temporary folder.
            ros_arguments=["--log-level", given["log_level"], *node.parameter_arguments(problem)],
            output="screen",
            respawn=True,
            respawn_delay=1.0,
        )
        for node in nodes
    ]


def end_if_refused(event: ProcessExited, context: LaunchContext) -> None:
    """End the launch, with an error, when a node refuses its parameters; it has said why."""
    if event.returncode == REFUSED and not context.is_shutdown:
        raise RuntimeError(f"{event.process_name} refuses to run; its last messages above say why")
