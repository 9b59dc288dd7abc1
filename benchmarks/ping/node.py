# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""ping_node: one end of a raw ping-pong, the reference of `python -m benchmarks rtt`.

Nothing but the middleware: bytes are published and taken as they are, on a WaitSet with one
subscription, with the quality of service of our topics. The end `ping` reads one JSON object a line
on stdin ({"seconds": s, "numbers": n}) and answers with one on stdout.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from pdeloop.messages.frames import ArrayCodec, Frame
from pdeloop.messages.spec import Spec
from pdeloop.messages.topics import ACTION, STATE, Topic
from pdeloop.process.affinity import pin_process
from pdeloop.process.isolation import keep_on_this_machine
from pdeloop.ros.endpoints import reader_qos, writer_qos
from pdeloop.ros.node_loop import NodeLoop
from pdeloop.ros.node_main import node_main
from pdeloop.ros.parameters import declare

PARAMETERS = (
    Spec("end", "ping", choices=("ping", "pong")).means("which end this is"),
    Spec("pin", -1, -1, 4095).means("core to stay on, polling before waiting; -1: none"),
)
OUT, BACK = (Topic(f"bench/{topic.name}", topic.labels, latched=False) for topic in (STATE, ACTION))
POLL = 200e-6
"""Seconds of polling before waiting, when pinned."""
BACK_SHARE = 12 / 256
"""Numbers in an answer for each number in a request: actuators and points of P2."""


class PingNode:
    """One end of the ping-pong."""

    def __init__(self, node: Node, loop: NodeLoop) -> None:
        given = {name: value.value for name, value in node._parameter_overrides.items()}
        values = declare(node, PARAMETERS, given)
        pin_process(values["pin"])
        self._poll = POLL if values["pin"] >= 0 else 0.0
        self._end = values["end"]
        self.join(node, loop)

    def join(self, node: Node, loop: NodeLoop) -> None:
        self._node, self._loop = node, loop
        own, other = (OUT, BACK) if self._end == "ping" else (BACK, OUT)
        self._publisher = node.create_publisher(Float64MultiArray, own.name, writer_qos(own))
        self._handle = node.create_subscription(
            Float64MultiArray, other.name, lambda _: None, reader_qos(other), raw=True
        ).handle
        self._wait_set = _rclpy.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)

    def run(self) -> int:
        if self._end == "pong":
            return self._pong()
        for line in sys.stdin:
            request = json.loads(line)
            print(json.dumps(self._ping(request["seconds"], request["numbers"])), flush=True)
        return 0

    def _take(self, limit: float) -> bytes | None:
        """The next message; None when none came for `limit` s."""
        take = self._handle.take_message
        if self._poll:
            end = time.monotonic() + self._poll
            while time.monotonic() < end:
                if taken := take(Float64MultiArray, True):
                    return bytes(taken[0])
        self._wait_set.clear_entities()
        self._wait_set.add_subscription(self._handle)
        self._wait_set.wait(int(limit * 1e9))
        taken = take(Float64MultiArray, True)
        return taken[0] if taken else None

    def _ping(self, seconds: float, numbers: int) -> dict[str, Any]:
        message = _message(numbers)
        publish, now = self._publisher.publish, time.perf_counter
        self._take(0.0)
        while True:  # until the other end is there
            publish(message)
            if self._take(0.1):
                break
        times: list[float] = []
        end = now() + seconds
        lost = 0
        began = now()
        while (start := now()) < end:
            publish(message)
            while self._take(0.05) is None:
                publish(message)
                lost += 1
            times.append(now() - start)
        elapsed = now() - began
        microseconds = np.percentile(np.array(times) * 1e6, (50, 99)).tolist()
        return {"rounds": len(times), "seconds": elapsed, "percentiles": microseconds, "lost": lost}

    def _pong(self) -> int:
        answers: dict[int, bytes] = {}
        first = len(_message(0))
        while not self._loop.stopped:
            request = self._take(0.05)
            if request is None:
                continue
            answer = answers.get(len(request))
            if answer is None:
                numbers = round((len(request) - first) // 8 * BACK_SHARE)
                answer = answers[len(request)] = _message(numbers)
            self._publisher.publish(answer)
        return 0


def _message(numbers: int) -> bytes:
    return ArrayCodec(STATE.labels).encode(Frame(1, 1, 1, 0.0, np.zeros((1, numbers))))


def main(args: list[str] | None = None) -> int:
    """Run by `python -m benchmarks.ping.node`."""
    keep_on_this_machine()
    return node_main("ping_node", args, PingNode)


if __name__ == "__main__":
    sys.exit(main())
