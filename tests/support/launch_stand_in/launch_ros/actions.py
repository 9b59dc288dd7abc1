# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The action that starts a node."""

from __future__ import annotations

import os
from pathlib import Path

from launch import LaunchContext, start


class Node:
    """`parameters` may not be given: launch_ros leaves a file for each dictionary among them."""

    def __init__(
        self,
        *,
        package: str,
        executable: str,
        namespace: str | None = None,
        ros_arguments: list[str],
        output: str = "log",
        respawn: bool = False,
        respawn_delay: float = 0.0,
        sigterm_timeout: str = "5",
        sigkill_timeout: str = "5",
    ) -> None:
        self.package, self.executable, self.namespace = package, executable, namespace or ""
        self.ros_arguments = ros_arguments
        self.respawn, self.respawn_delay = respawn, respawn_delay
        self.sigterm_timeout = float(sigterm_timeout)

    def visit(self, context: LaunchContext) -> None:
        words = [str(self._file()), "--ros-args", *self.ros_arguments]
        if self.namespace:
            words += ["-r", f"__ns:=/{self.namespace}"]
        start(self, words, context)

    def _file(self) -> Path:
        """As `ros2 run` finds it."""
        prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        files = [Path(p) / "lib" / self.package / self.executable for p in prefixes]
        return next((file for file in files if file.is_file()), files[0])
