"""Reads a loop for people: when it is told to, never woken by a message.

A loop of thousands of rounds a second would wake who waits for its messages as often, and take a
processor core from itself. Whoever draws some pictures a second takes what has come in before each:
DRAIN is short enough for the depth of the latched topics.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence

from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from loop_interfaces.frames import ArrayCodec, Frame
from loop_interfaces.ros.endpoints import raw_subscription, reader_qos
from loop_interfaces.ros.sample_subscription import Watcher
from loop_interfaces.samples import ACTION_KIND, STATE_KIND
from loop_interfaces.topics import ACTION, STATE, Topic

DRAIN = 0.03
"""Seconds between two looks at what has come in."""
Handler = Callable[[Frame, float], None]
"""Called with a frame and the time (monotonic s)."""


def drain(
    starts: Sequence[Reader], samples: Samples | None, costs: Sequence[Reader]
) -> tuple[int, int]:
    """Take from all and hand on; how many samples, and their bytes.

    Taken in one order and handled in another: when a cost has come in, so have all samples of its
    episode, and its start.
    """
    ended = [(reader, reader.take()) for reader in costs]
    for reader in starts:
        reader.handle(reader.take())
    taken = samples.drain() if samples is not None else (0, 0)
    for reader, messages in ended:
        reader.handle(messages)
    return taken


class Reader:
    """Takes frames of one latched topic when it is told to."""

    def __init__(self, node: Node, topic: Topic, name: str, handle: Handler) -> None:
        self._node, self._handle = node, handle
        self._decode = ArrayCodec(topic.labels).decode
        self._subscription = raw_subscription(node, Float64MultiArray, name, reader_qos(topic))

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

    def __init__(self, node: Node, namespace: str, state: Handler, action: Handler) -> None:
        self._watcher = Watcher(node, namespace, throttled=True)
        self._watcher.look()
        self._handlers: dict[int, tuple[Callable[[bytes], Frame], Handler]] = {
            STATE_KIND: (ArrayCodec(STATE.labels).decode, state),
            ACTION_KIND: (ArrayCodec(ACTION.labels).decode, action),
        }
        self.close = self._watcher.close

    def look(self) -> None:
        """Look at the graph now and then: where the samples are to be had."""
        self._watcher.look()

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
