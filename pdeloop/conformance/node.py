# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The loop's topics for the checks of pdeloop.conformance."""

from __future__ import annotations

import secrets
import time
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Float64MultiArray, String

from loop_interfaces.frames import MAX_ID
from loop_interfaces.isolation import keep_on_this_machine
from loop_interfaces.protocol import ModelFailure
from loop_interfaces.ros.endpoints import Sender, reader_qos, scoped, writer_qos
from loop_interfaces.ros.node_main import ros_node
from loop_interfaces.topics import ARRAYS, Topic
from pdeloop.conformance.controller import ControllerCheck
from pdeloop.conformance.plant import PlantCheck
from pdeloop.conformance.probing import FAILED, Check, Message
from pdeloop.conformance.tuner import TunerCheck
from pdeloop.interruption import Interruption
from pdeloop.problem_check import Finding

CHECKS: dict[str, type[Check]] = {
    "plant": PlantCheck,
    "controller": ControllerCheck,
    "tuner": TunerCheck,
}
KEPT = 200
"""Frames that wait to be looked at."""
WAIT = 0.1
"""Seconds of one wait at most: a wait does not end by a signal."""


class RosTransport:
    """The topics of a namespace in this ROS domain; `published` are those of the checked node."""

    def __init__(self, published: tuple[Topic, ...], namespace: str, node: Node) -> None:
        self._stopped, self.received_any, self.refused = "", False, ""
        self._inbox: deque[tuple[Topic, Message]] = deque(maxlen=KEPT)
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._send: dict[Topic, Callable[[Any], None]] = {}
        self._publishers: list[Publisher] = []
        for topic in ARRAYS:
            if topic in published:
                take = partial(self._take, topic, topic.codec().decode)
                name, qos = scoped(namespace, topic.name), reader_qos(topic)
                node.create_subscription(Float64MultiArray, name, take, qos, raw=True)
            else:
                sender = Sender(node, topic, namespace)
                self._send[topic] = sender.send
                self._publishers.append(sender.publisher)
        failed = scoped(namespace, FAILED.name)
        if FAILED in published:
            take = partial(self._take, FAILED, lambda message: ModelFailure.from_json(message.data))
            node.create_subscription(String, failed, take, reader_qos(FAILED))
        else:
            failures = node.create_publisher(String, failed, writer_qos(FAILED))
            self._send[FAILED] = lambda told: failures.publish(String(data=told.to_json()))

    def now(self) -> float:
        return time.monotonic()

    def send(self, topic: Topic, message: Message) -> None:
        self._send[topic](message)

    def next(self, *topics: Topic, seconds: float) -> tuple[Topic, Message] | None:
        end = self.now() + seconds
        while True:
            if self._stopped:
                raise Interruption(self._stopped)
            for found in self._inbox:
                if found[0] in topics:
                    self._inbox.remove(found)
                    return found
            left = end - self.now()
            if left < 0.0:
                return None
            self._executor.spin_once(timeout_sec=min(left, WAIT))

    def wait_delivered(self) -> None:
        for publisher in self._publishers:
            publisher.wait_for_all_acked(Duration(seconds=1))

    def stop(self, reason: str) -> None:
        """End the check; called by a signal."""
        self._stopped = reason

    def _take(self, topic: Topic, decode: Callable[[Any], Message], raw: Any) -> None:
        self.received_any = True
        try:
            self._inbox.append((topic, decode(raw)))
        except ValueError as error:
            self.refused = f"`{topic.name}`: {error}"


def check_node(
    kind: str, *, namespace: str = "", network: bool = False, **options: Any
) -> Iterator[Finding]:
    """Check the plant, controller or tuner in this ROS domain. options: see Check."""
    if not network:
        keep_on_this_machine()
    make = CHECKS[kind]
    with ros_node("pdeloop_check", [], partial(RosTransport, make.published, namespace)) as (
        _,
        transport,
    ):
        yield from make(transport, run=1 + secrets.randbelow(MAX_ID - 1000), **options).findings()
