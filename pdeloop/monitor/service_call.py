# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Calls of the services of the loop's nodes without waiting."""

from __future__ import annotations

import time
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from viewer_node.loop_nodes import Call, Operation

CONNECTION = 5.0
"""Seconds within which the service must be there."""
ANSWER = 300.0
"""Seconds within which it must answer: a node that computes answers when it is done."""


class ServiceCall:
    """A call of a service that is under way."""

    def __init__(self, node: Node, call: Call) -> None:
        self._node, self._call = node, call
        self._since = time.monotonic()
        self._client = node.create_client(Trigger, f"{call.node}/{call.verb}")
        self._future: Any = None

    def poll(self, operation: Operation) -> bool:
        """Proceed; True when the call is over and its result is stored."""
        now = time.monotonic()
        if self._future is None and self._client.service_is_ready():
            self._future = self._client.call_async(Trigger.Request())
        if self._future is not None and self._future.done():
            answer = self._future.result()
            operation.answered(self._call, now, None if answer.success else str(answer.message))
        elif now - self._since > (CONNECTION if self._future is None else ANSWER):
            waited = f"did not answer within {now - self._since:.0f} s"
            operation.answered(self._call, now, waited)
        else:
            return False
        self._node.destroy_client(self._client)
        return True
