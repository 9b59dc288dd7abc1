# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""relay_node: sits on the state and action topics between a plant and a controller.

Start the plant with `-r state:=state_sent` and the controller with `-r action:=action_sent`; the
relay passes state_sent on to state and action_sent on to action, with faults.
"""

from __future__ import annotations

import heapq
import itertools
import sys
import time
from functools import partial

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Float64MultiArray

from pdeloop.messages.spec import Spec
from pdeloop.messages.topics import ACTION, STATE, Topic
from pdeloop.process.isolation import keep_on_this_machine
from pdeloop.ros.endpoints import reader_qos, writer_qos
from pdeloop.ros.node_main import node_main
from pdeloop.ros.observer import Observer
from pdeloop.ros.parameters import declare

PARAMETERS = (
    Spec("loss", 0.0, 0.0, 0.99).means("probability that a message is lost"),
    Spec("duplicate", 0.0, 0.0, 1.0).means("probability that a message is sent twice"),
    Spec("delay", 0.0, 0.0, 10.0, unit="s").means(
        "largest delay of a message; smaller ones overtake"
    ),
    Spec("seed", 0, 0, 2**31 - 1).means("seed of the faults"),
)
TICK = 0.001
"""Seconds between two rounds of passing on what is due."""


class Direction:
    """One direction of the relay; each message is delayed by a random time in [0, delay] s."""

    def __init__(self, loss: float, duplicate: float, delay: float, seed: list[int]) -> None:
        self._loss, self._duplicate, self._delay = loss, duplicate, delay
        self._rng = np.random.default_rng(seed)
        self._queue: list[tuple[float, int, bytes]] = []
        self._count = itertools.count()
        self.lost = self.duplicated = self.passed = 0

    def put(self, message: bytes) -> None:
        """Take a message that has just arrived."""
        if self._rng.random() < self._loss:
            self.lost += 1
            return
        repeated = bool(self._rng.random() < self._duplicate)
        self.duplicated += repeated
        for _ in range(1 + repeated):
            due = time.monotonic() + self._delay * self._rng.random()
            heapq.heappush(self._queue, (due, next(self._count), message))

    def due(self) -> list[bytes]:
        """The messages to pass on now."""
        found = []
        while self._queue and self._queue[0][0] <= time.monotonic():
            found.append(heapq.heappop(self._queue)[2])
        self.passed += len(found)
        return found

    @property
    def waiting(self) -> bool:
        """True while a message waits until it is due."""
        return bool(self._queue)


class RelayNode:
    """Passes raw messages on; it never looks into them."""

    def __init__(self, node: Node, loop: Observer) -> None:
        given = {name: value.value for name, value in node._parameter_overrides.items()}
        values = declare(node, PARAMETERS, given)
        seed = values.pop("seed")
        self._directions = {
            topic: Direction(**values, seed=[seed, number])
            for number, topic in enumerate((STATE, ACTION))
        }
        self.join(node, loop)

    def join(self, node: Node, loop: Observer) -> None:
        self._node, self._loop = node, loop
        self._publishers: dict[Topic, Publisher] = {}
        for topic, direction in self._directions.items():
            sent, qos = f"{topic.name}_sent", reader_qos(topic, 100)
            publisher = node.create_publisher(Float64MultiArray, topic.name, writer_qos(topic))

            take = partial(self._take, direction, publisher)
            node.create_subscription(Float64MultiArray, sent, take, qos, raw=True)
            self._publishers[topic] = publisher
        # It runs while a message waits: always, it would take half a core.
        self._timer = node.create_timer(
            TICK, self._pass_on, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def _pass_on(self) -> None:
        for topic, publisher in self._publishers.items():
            self._send(self._directions[topic], publisher)
        if not any(direction.waiting for direction in self._directions.values()):
            self._timer.cancel()

    def _take(self, direction: Direction, publisher: Publisher, message: bytes) -> None:
        direction.put(message)
        self._send(direction, publisher)
        if direction.waiting and self._timer.is_canceled():
            self._timer.reset()

    def _send(self, direction: Direction, publisher: Publisher) -> None:
        for message in direction.due():
            publisher.publish(message)

    def run(self) -> int:
        """Pass messages on until stopped; says at the end what it did."""
        self._loop.run()
        for topic, direction in self._directions.items():
            self._node.get_logger().info(
                f"{topic.name}: {direction.passed} passed, {direction.lost} lost, "
                f"{direction.duplicated} duplicated"
            )
        return 0


def main() -> int:
    keep_on_this_machine()
    return node_main("relay_node", None, RelayNode, Observer)


if __name__ == "__main__":
    sys.exit(main())
