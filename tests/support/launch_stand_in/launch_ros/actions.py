# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The action that starts a node."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import yaml
from launch import LaunchContext, start


class Node:
    def __init__(
        self,
        *,
        package: str,
        executable: str,
        namespace: str | None = None,
        parameters: list[Any],
        ros_arguments: list[str],
        output: str = "log",
        respawn: bool = False,
        respawn_delay: float = 0.0,
        sigterm_timeout: str = "5",
        sigkill_timeout: str = "5",
    ) -> None:
        self.package, self.executable, self.namespace = package, executable, namespace or ""
        self.parameters, self.ros_arguments = parameters, ros_arguments
        self.respawn, self.respawn_delay = respawn, respawn_delay
        self.sigterm_timeout = float(sigterm_timeout)

    def visit(self, context: LaunchContext) -> None:
        words = [str(self._file()), "--ros-args"]
        if self.namespace:
            words += ["-r", f"__ns:=/{self.namespace}"]
        for given in self.parameters:
            words += ["--params-file", str(_written(given) if isinstance(given, dict) else given)]
        start(self, [*words, *self.ros_arguments], context)

    def _file(self) -> Path:
        """As `ros2 run` finds it."""
        prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        files = [Path(p) / "lib" / self.package / self.executable for p in prefixes]
        return next((file for file in files if file.is_file()), files[0])


def _written(parameters: dict[str, Any]) -> str:
    """The path of a parameter file with them."""
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", delete=False) as file:
        yaml.safe_dump({"/**": {"ros__parameters": parameters}}, file)
    return file.name
