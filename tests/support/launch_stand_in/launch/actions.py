# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Actions of launch files."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from launch import LaunchContext, shut_down


class DeclareLaunchArgument:
    def __init__(
        self, name: str, *, default_value: str, description: str, choices: list[str] | None = None
    ) -> None:
        self.name, self.default_value = name, default_value
        self.description, self.choices = description, choices

    def visit(self, context: LaunchContext) -> None:
        value = context.launch_configurations.setdefault(self.name, self.default_value)
        if self.choices is not None and value not in self.choices:
            raise RuntimeError(
                f'Argument "{self.name}" provided value "{value}" is not valid. '
                f"Valid options are: {self.choices}"
            )


class OpaqueFunction:
    def __init__(self, *, function: Callable[[LaunchContext], Any]) -> None:
        self.visit = function


class SetEnvironmentVariable:
    def __init__(self, name: str, value: str) -> None:
        self.name, self.value = name, value

    def visit(self, context: LaunchContext) -> None:
        context.environment[self.name] = self.value


class LogInfo:
    def __init__(self, *, msg: str) -> None:
        self.message = msg

    def visit(self, context: LaunchContext) -> None:
        print(f"[INFO] [launch.user]: {self.message}", flush=True)


class RegisterEventHandler:
    def __init__(self, event_handler: Any) -> None:
        self.handler = event_handler

    def visit(self, context: LaunchContext) -> None:
        context.handlers.append(self.handler)


class Shutdown:
    def __init__(self, *, reason: str) -> None:
        self.reason = reason

    def visit(self, context: LaunchContext) -> None:
        shut_down(context, self.reason)


class IncludeLaunchDescription:
    def __init__(self, source: Any, *, launch_arguments: Iterable[tuple[str, str]] = ()) -> None:
        self.source, self.arguments = source, list(launch_arguments)

    def visit(self, context: LaunchContext) -> Any:
        context.launch_configurations.update(self.arguments)
        return self.source.get_launch_description(context).entities
