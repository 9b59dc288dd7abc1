# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The loop's topics for the checks of pdeloop.conformance."""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Float64MultiArray, String

from pdeloop.conformance.controller import ControllerCheck
from pdeloop.conformance.plant import PlantCheck
from pdeloop.conformance.probing import FAILED, Check, Message
from pdeloop.conformance.tuner import TunerCheck
from pdeloop.interruption import Interruption
from pdeloop.messages.frames import MAX_ID
from pdeloop.messages.protocol import ModelFailure
from pdeloop.messages.topics import ARRAYS, Topic
from pdeloop.problem_check import Finding
from pdeloop.process.isolation import keep_on_this_machine
from pdeloop.ros.endpoints import Sender, reader_qos, scoped, writer_qos
from pdeloop.ros.introspection import PERIOD, full_name, incompatible
from pdeloop.ros.node_main import ros_node
from pdeloop.ros.observer import WAIT, EventLoop

CHECKS: dict[str, type[Check]] = {
    "plant": PlantCheck,
    "controller": ControllerCheck,
    "tuner": TunerCheck,
}
KEPT = 200
"""Frames that wait to be looked at."""
NAMING = 5.0
"""Seconds within which a publisher that was discovered has a name."""
DRAINING = 0.2
"""Seconds at most in which what has arrived is taken, without a wait."""


class RosTransport(EventLoop):
    """The topics of a namespace in this ROS domain; `published` are those of the checked node."""

    def __init__(self, published: tuple[Topic, ...], namespace: str, node: Node) -> None:
        super().__init__(node)
        self.received_any, self.refused = False, ""
        self._inbox: deque[tuple[Topic, Message]] = deque(maxlen=KEPT)
        self._looked = 0.0
        self._checked_topics: list[str] = []
        self._send: dict[Topic, Callable[[Any], None]] = {}
        self._publishers: list[Publisher] = []
        for topic in (*ARRAYS, FAILED):
            name = node.resolve_topic_name(scoped(namespace, topic.name))
            self.introspection.supervise(name, reader_qos(topic))
            self._checked_topics += [name] if topic in published else []
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
            self._publishers.append(failures)
            self._send[FAILED] = lambda told: failures.publish(String(data=told.to_json()))

    def send(self, topic: Topic, message: Message) -> None:
        self._send[topic](message)

    def next(self, *topics: Topic, seconds: float) -> tuple[Topic, Message] | None:
        end = self.now() + seconds
        idle = 0
        while True:
            if self.stop_reason:
                raise Interruption(self.stop_reason)
            for found in self._inbox:
                if found[0] in topics:
                    self._inbox.remove(found)
                    return found
            now = self.now()
            # An executor that has just served something says at first that nothing is ready.
            if (now >= end and idle >= 2) or now >= end + DRAINING:
                return None
            if now >= self._looked + PERIOD:
                self._looked = now
                self.introspection.look_at_publishers(now)
            served = self.serve_next(min(max(0.0, end - now), WAIT))
            idle = 0 if served else idle + 1

    def disturbance(self, seconds: float = 0.0) -> str:
        began = self.now()
        while True:
            named = self.introspection.look_at_publishers(self.now())
            for topic, names in self.introspection.several_publishers.items():
                return (
                    f"several nodes publish {topic}: {', '.join(names)}; stop all but the one to be "
                    "checked, or give it a ROS_DOMAIN_ID or --namespace of its own"
                )
            for text in self.introspection.unreachable.values():
                return f"{text}; expected a publisher as in docs/protocol.md"
            if deaf := self._deaf():
                return deaf
            end = began + (seconds if named else max(seconds, NAMING))
            if self.now() >= end and not self.introspection.undecided:
                return ""
            if self.stop_reason:
                raise Interruption(self.stop_reason)
            self.serve_next(WAIT)

    def wait_delivered(self) -> None:
        for publisher in self._publishers:
            publisher.wait_for_all_acked(Duration(seconds=1))

    def _deaf(self) -> str:
        """Which topic of the check the checked node cannot receive, and why; or empty."""
        topics, graph = [publisher.topic_name for publisher in self._publishers], self.node
        publishing = [graph.get_publishers_info_by_topic(name) for name in self._checked_topics]
        checked = {full_name(endpoint) for endpoints in publishing for endpoint in endpoints}
        for name in topics:
            offered = [e.qos_profile for e in graph.get_publishers_info_by_topic(name)]
            for reader in graph.get_subscriptions_info_by_topic(name):
                if full_name(reader) not in checked or not offered:
                    continue
                if why := incompatible(offered[0], reader.qos_profile):
                    return (
                        f"{full_name(reader)} subscribes {name}, but its messages cannot arrive "
                        f"(QoS: {why}); expected a subscriber as in docs/protocol.md"
                    )
        return ""

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
