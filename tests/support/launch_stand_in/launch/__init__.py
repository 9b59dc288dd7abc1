# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""As much of ROS's `launch` as the launch files use, where it is not installed: it is not on PyPI.

Same names, same meaning, no substitutions and no remote anything. With LAUNCH_DRY_RUN=1 it prints what
it would start, one JSON object a line.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any


@dataclass
class LaunchContext:
    """What actions see: the arguments, and whether the launch is on its way out."""

    launch_configurations: dict[str, str] = field(default_factory=dict)
    is_shutdown: bool = False
    handlers: list[Any] = field(default_factory=list)
    processes: list[Any] = field(default_factory=list)

    @property
    def environment(self) -> Any:
        return os.environ


class LaunchDescription:
    """A list of actions."""

    def __init__(self, entities: Iterable[Any] = ()) -> None:
        self.entities = list(entities)

    def get_launch_arguments(self) -> list[Any]:
        return [entity for entity in self.entities if hasattr(entity, "default_value")]


class LaunchService:
    """Visits the actions, then looks after the processes until none is left."""

    def __init__(self, argv: Iterable[str] = (), noninteractive: bool = False) -> None:
        self.context = LaunchContext()
        self._description = LaunchDescription()

    def include_launch_description(self, description: LaunchDescription) -> None:
        self._description = description

    def run(self) -> int:
        """0, or 1 after an exception in an action or a handler."""
        context, code = self.context, 0
        signal.signal(signal.SIGINT, lambda *_: shut_down(context, "the user's interrupt"))
        try:
            visit(self._description.entities, context)
            while any(process.wanted for process in context.processes):
                for process in list(context.processes):
                    process.look(context)
                time.sleep(0.02)
        except Exception as error:
            print(f"[ERROR] [launch]: Caught exception in launch: {error}", flush=True)
            code = 1
            shut_down(context, "an exception")
        for process in context.processes:
            process.end()
        return code


def visit(entities: Iterable[Any] | None, context: LaunchContext) -> None:
    """Perform the actions, and those that they give."""
    for entity in entities or ():
        visit(entity.visit(context), context)


def shut_down(context: LaunchContext, reason: str) -> None:
    """Interrupt all processes, once."""
    if not context.is_shutdown:
        print(f"[INFO] [launch]: shutting down: {reason}", flush=True)
        context.is_shutdown = True
        for process in context.processes:
            process.interrupt()


@dataclass
class Process:
    """A process that an action started; `action` has what to do about its end."""

    action: Any
    command: list[str]
    child: subprocess.Popen[bytes] | None = None
    again_at: float = 0.0
    wanted: bool = True

    def look(self, context: LaunchContext) -> None:
        if self.child is None:
            if context.is_shutdown or not self.wanted:
                self.wanted = False
            elif time.monotonic() >= self.again_at:
                self.child = subprocess.Popen(self.command)
                print(f"[INFO] [{self.action.executable}]: process started", flush=True)
            return
        code = self.child.poll()
        if code is None:
            return
        self.child = None
        how = "finished cleanly" if code == 0 else f"has died [exit code {code}]"
        print(f"[INFO] [{self.action.executable}]: process {how}", flush=True)
        event = ProcessExited(self.action, self.action.executable, code)
        for handler in context.handlers:
            visit(handler(event, context), context)
        self.wanted = self.action.respawn and not context.is_shutdown
        self.again_at = time.monotonic() + self.action.respawn_delay

    def interrupt(self) -> None:
        if self.child is not None:
            self.child.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Wait for an interrupted process; after its time it is killed."""
        if self.child is not None:
            try:
                self.child.wait(self.action.sigterm_timeout)
            except subprocess.TimeoutExpired:
                print(f"[ERROR] [{self.action.executable}]: escalating to SIGKILL", flush=True)
                self.child.kill()
                self.child.wait()


@dataclass
class ProcessExited:
    """The event that a process has ended."""

    action: Any
    process_name: str
    returncode: int


def start(action: Any, command: list[str], context: LaunchContext) -> None:
    """Start a process for an action, or say so."""
    if os.environ.get("LAUNCH_DRY_RUN"):
        told = {"executable": action.executable, "namespace": action.namespace}
        told["arguments"] = action.ros_arguments
        told["environment"] = {n: v for n, v in os.environ.items() if n.startswith("PDELOOP_")}
        json.dump(told, sys.stdout)
        print(flush=True)
        return
    process = Process(action, command)
    context.processes.append(process)
    process.look(context)


Handler = Callable[[ProcessExited, LaunchContext], Any]
