# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Where a launch description comes from."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from launch import LaunchContext, LaunchDescription


class PythonLaunchDescriptionSource:
    def __init__(self, path: str) -> None:
        self.path = path

    def get_launch_description(self, context: LaunchContext) -> LaunchDescription:
        spec: Any = importlib.util.spec_from_file_location(Path(self.path).stem, self.path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        description: LaunchDescription = module.generate_launch_description()
        return description


AnyLaunchDescriptionSource = PythonLaunchDescriptionSource
