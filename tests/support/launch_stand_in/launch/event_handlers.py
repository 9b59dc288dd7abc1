# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What happens when a process ends."""

from __future__ import annotations

from typing import Any

from launch import Handler, LaunchContext, ProcessExited


class OnProcessExit:
    def __init__(self, *, on_exit: Handler, target_action: Any = None) -> None:
        self.on_exit, self.target = on_exit, target_action

    def __call__(self, event: ProcessExited, context: LaunchContext) -> Any:
        return self.on_exit(event, context) if self.target in (None, event.action) else None
