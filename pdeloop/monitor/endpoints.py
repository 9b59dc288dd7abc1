"""How the monitor calls the services of the loop's nodes, never waiting."""

from __future__ import annotations

import time
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from pdeloop.monitor.commands import Call
from pdeloop.monitor.view import View

PATIENCE = 5.0
"""Seconds in which a service must answer."""


class ServiceCall:
    """A call of a service that is under way."""

    def __init__(self, node: Node, call: Call) -> None:
        self.call, self._node, self._since = call, node, time.monotonic()
        self._client = node.create_client(Trigger, f"{call.node}/{call.verb}")
        self._future: Any = None

    def poll(self, view: View) -> bool:
        """Go on; True when it is over."""
        now = time.monotonic()
        if self._future is None and self._client.service_is_ready():
            self._future = self._client.call_async(Trigger.Request())
        done = self._future is not None and self._future.done()
        if done:
            answer = self._future.result()
            if answer.success:
                view.answered(self.call.node, self.call.verb, now)
            self.call.tell(bool(answer.success), str(answer.message))
        elif now - self._since > PATIENCE:
            self.call.fail(
                f"{self.call.node}/{self.call.verb} did not answer within {PATIENCE:g} s"
            )
        else:
            return False
        self._node.destroy_client(self._client)
        return True
