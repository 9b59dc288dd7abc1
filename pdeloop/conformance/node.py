# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The loop's topics for the checks of pdeloop.conformance.checks."""

from __future__ import annotations

import secrets
import time
from collections import deque
from collections.abc import Iterator
from functools import partial

import rclpy
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from loop_interfaces.frames import MAX_ID, ArrayCodec, Frame
from loop_interfaces.isolation import keep_on_this_machine
from loop_interfaces.ros.endpoints import Sender, reader_qos
from loop_interfaces.ros.node_main import ros_node
from loop_interfaces.topics import ARRAYS, Topic
from pdeloop.conformance.checks import CHECKS
from pdeloop.problem_check import Finding

KEPT = 1000
"""Messages that wait to be looked at."""


class RosWire:
    """The topics of the present ROS domain; `published` are those of the checked node."""

    def __init__(self, published: tuple[Topic, ...], node: Node) -> None:
        self._node, self._stopped = node, False
        self._inbox: deque[tuple[Topic, Frame]] = deque(maxlen=KEPT)
        self.heard, self.refused = False, ""
        """Whether any message came; what was wrong with the last one that was refused."""
        self._senders = {t.name: Sender(node, t) for t in ARRAYS if t not in published}
        for topic in published:
            take = partial(self._take, topic, ArrayCodec(topic.labels))
            node.create_subscription(
                Float64MultiArray, topic.name, take, reader_qos(topic), raw=True
            )

    def send(self, topic: Topic, frame: Frame) -> None:
        self._senders[topic.name].send(frame)

    def next(self, *topics: Topic, seconds: float) -> tuple[Topic, Frame] | None:
        end = time.monotonic() + seconds
        while True:
            for found in self._inbox:
                if found[0] in topics:
                    self._inbox.remove(found)
                    return found
            if self._stopped:
                raise KeyboardInterrupt
            if (left := end - time.monotonic()) <= 0.0:
                return None
            rclpy.spin_once(self._node, timeout_sec=left)

    def stop(self, reason: str) -> None:
        """End the check; called by a signal."""
        self._stopped = True

    def _take(self, topic: Topic, codec: ArrayCodec, raw: bytes) -> None:
        self.heard = True
        try:
            self._inbox.append((topic, codec.decode(raw)))
        except ValueError as error:
            self.refused = f"{topic.name}: {error}"


def check_node(kind: str, *, n_a: int, patience: float, network: bool) -> Iterator[Finding]:
    """What is found of the plant, controller or tuner in this ROS domain."""
    if not network:
        keep_on_this_machine()
    check = CHECKS[kind]
    with ros_node("pdeloop_check", [], partial(RosWire, check.published)) as (_, wire):
        run = 1 + secrets.randbelow(MAX_ID - 2)
        yield from check(wire, n_a, patience=patience, run=run).all()
        if wire.heard:
            yield Finding("messages", not wire.refused, wire.refused or "all of them well formed")
