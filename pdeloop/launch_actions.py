"""Launch actions of a plan: the one module that imports launch and launch_ros.

It runs inside `ros2 launch`, from the files in launch/. What is started is decided, without ROS, in
pdeloop.launch_plan.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch_ros.actions import Node

from loop_interfaces.protocol import STOPPED
from pdeloop.launch_plan import Argument, Plan
from pdeloop.pairs import LoopNode
from pdeloop.supervisor import BACK_OFF, RECORDER_GRACE, REFUSED, NodeError

_RESPAWN_DELAY = 1.0
"""Seconds before a node that died is started again."""

_ENDED = {0: "is done", 130: "was interrupted", STOPPED: "was stopped on request"}
"""Exit codes of a tuner that does not want to be started again."""


def description(
    arguments: Iterable[Argument], make: Callable[[Mapping[str, str]], Plan]
) -> LaunchDescription:
    """A launch file that declares `arguments` and starts the plan that `make` makes of them."""
    names = [argument.spec.name for argument in arguments]

    def begin(context: LaunchContext) -> list[Any]:
        plan = make({name: context.launch_configurations[name] for name in names})
        said = [LogInfo(msg=f"training in {plan.folder}")] if plan.folder else []
        deaths: Counter[str] = Counter()
        return [*said, *(_action(node, plan, deaths) for node in plan.nodes)]

    declared = [
        DeclareLaunchArgument(
            argument.spec.name,
            default_value=argument.default,
            description=argument.description,
            choices=argument.choices or None,
        )
        for argument in arguments
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=begin)])


def _action(node: LoopNode, plan: Plan, deaths: Counter[str]) -> Any:
    recorder = node.package == "recorder_node"
    namespace = "/".join(n for n in (plan.namespace.rstrip("/"), node.namespace) if n)
    grace = str(RECORDER_GRACE) if recorder else "5"
    return Node(
        package="pdeloop",
        executable=node.package,
        namespace=namespace or None,
        ros_arguments=[*node.arguments(plan.parameter_file), "--log-level", plan.log_level],
        additional_env={**plan.environment, "PYTHONUNBUFFERED": "1"},
        output="screen",
        respawn=not recorder,
        respawn_delay=_RESPAWN_DELAY,
        sigterm_timeout=grace,
        sigkill_timeout=grace,
        on_exit=lambda event, context: _after(node, event, context, deaths),
    )


def _after(
    node: LoopNode, event: ProcessExited, context: LaunchContext, deaths: Counter[str]
) -> list[Any]:
    """What follows the end of `node`; NodeError ends the launch with an exit code of its own."""
    if context.is_shutdown:
        return []
    code = event.returncode
    if node.package == "tuner_node" and code in _ENDED:
        return [Shutdown(reason=f"the training {_ENDED[code]}")]
    if code == REFUSED:
        raise NodeError(f"{node.name} refuses to run; its last words are above")
    if node.package == "recorder_node":
        return [LogInfo(msg=f"{node.name} ended with code {code}; going on without it")]
    deaths[node.name] += node.package != "viewer_node"  # which the training can do without
    if deaths[node.name] > len(BACK_OFF):
        raise NodeError(f"{node.name} ended with code {code} for the {deaths[node.name]}th time")
    return [LogInfo(msg=f"{node.name} ended with code {code}; starting it again")]
