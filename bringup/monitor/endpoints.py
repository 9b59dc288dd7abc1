"""How the monitor reads the loop's topics and calls its services: when it is told to, never waiting."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from bringup.monitor.commands import Call
from bringup.monitor.view import View
from loop_interfaces.endpoints import OutsideExecutor, reader_qos
from loop_interfaces.frames import ArrayCodec, Frame
from loop_interfaces.samples import ACTION_KIND, STATE_KIND
from loop_interfaces.topics import ACTION, STATE, Topic
from loop_interfaces.watching import Watcher

PATIENCE = 5.0
"""Seconds in which a service must answer."""
Handler = Callable[[Frame, float], None]


class Reader:
    """Takes frames of one latched topic when it is told to."""

    def __init__(self, node: Node, topic: Topic, name: str, handle: Handler) -> None:
        self._node, self._handle = node, handle
        self._decode = ArrayCodec(topic.labels).decode
        self._subscription: Subscription = node.create_subscription(
            Float64MultiArray,
            name,
            lambda _: None,  # never called: see OutsideExecutor
            reader_qos(topic),
            callback_group=OutsideExecutor(),
            raw=True,
        )

    def take(self) -> list[bytes]:
        """What has come in."""
        take, found = self._subscription.handle.take_message, []
        while (taken := take(Float64MultiArray, True)) is not None:
            found.append(taken[0])
        return found

    def handle(self, messages: list[bytes]) -> None:
        """Hand messages on."""
        now = time.monotonic()
        for raw in messages:
            with contextlib.suppress(ValueError):  # the loop's nodes report what they refuse
                self._handle(self._decode(raw), now)

    def close(self) -> None:
        self._node.destroy_subscription(self._subscription)


class Samples:
    """Takes states and actions, from when it is made until it is closed."""

    def __init__(self, node: Node, namespace: str, view: View) -> None:
        self._watcher = Watcher(node, namespace, throttled=True)
        self._watcher.look()
        self._handlers: dict[int, tuple[Callable[[bytes], Frame], Handler]] = {
            STATE_KIND: (ArrayCodec(STATE.labels).decode, view.state),
            ACTION_KIND: (ArrayCodec(ACTION.labels).decode, view.action),
        }
        self.look, self.close = self._watcher.look, self._watcher.close

    def drain(self) -> tuple[int, int]:
        """Handle what has come in; how many messages, and their bytes."""
        count = size = 0
        now = time.monotonic()
        with contextlib.suppress(ValueError):
            for kind, _, raw in self._watcher.drain():
                count, size = count + 1, size + len(raw)
                if kind in self._handlers:
                    decode, handle = self._handlers[kind]
                    with contextlib.suppress(ValueError):
                        handle(decode(raw), now)
        return count, size


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
