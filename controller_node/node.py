# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""controller_node: the projected LQ-tracking law as a ROS 2 node.

Subscribes  state, target, episode/start, policy, model, episode/cost
            episode/paused (for /diagnostics only)
Publishes   action, model/identified, model/failed
Messages and their order: docs/protocol.md. The protocol is controller_node.responder.
"""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from controller_node.diagnostics import ControllerDiagnostics
from controller_node.identification import DesignSettings
from controller_node.law import load_compiled
from controller_node.responder import Responder
from pdeloop.messages import topics
from pdeloop.messages.diagnostics import Status
from pdeloop.messages.frames import Frame
from pdeloop.messages.parameters import model_order, taken_by
from pdeloop.messages.protocol import ModelFailure, Publication
from pdeloop.messages.topics import Topic
from pdeloop.method.method_settings import shared_methods
from pdeloop.method.settings import parameters_of, with_defaults
from pdeloop.process.affinity import pin_process
from pdeloop.process.isolation import keep_on_this_machine
from pdeloop.ros.endpoints import writer_qos
from pdeloop.ros.node_loop import NodeLoop
from pdeloop.ros.node_main import node_main
from pdeloop.ros.parameters import declare, given_parameters

FAST_PATH = import_module("controller_node.fast_path") if find_spec("pdeloop.fast_path") else None
"""Answers states in compiled code, where that can be had; without it the responder answers all."""

Handler = Callable[[Frame], Sequence[Publication | ModelFailure]]


def declare_parameters(node: Node) -> dict[str, Any]:
    """The controller's parameters, with the settings of the methods that it shares with the tuner."""
    given = given_parameters(node, "controller_node")
    values = declare(node, taken_by("controller_node"), given)
    for method in shared_methods(values):
        with_defaults(method.prefix, method.settings, given, method.name)  # refuses unknown ones
        values |= declare(node, parameters_of(method.prefix, method.settings), given)
    return values


class ControllerNode:
    """Moves messages between the topics and the responder."""

    def __init__(self, node: Node, loop: NodeLoop) -> None:
        values = declare_parameters(node)
        pin_process(values["pin"])
        responder = Responder(DesignSettings.of(values))
        self._responder = responder
        self._diagnostics = ControllerDiagnostics(responder)
        load_compiled()  # before there is a publisher: a peer that discovers one expects answers
        if FAST_PATH:
            FAST_PATH.load_compiled()
        self.join(node, loop)
        order = model_order(values) or "suggested by the data"
        node.get_logger().info(
            f"{values['problem']}: tracking law '{values['law']}', order {order}"
        )

    def join(self, node: Node, loop: NodeLoop) -> None:
        responder = self._responder
        self._node, self._loop = node, loop
        self._senders = {
            topic: loop.sender(topic) for topic in (topics.ACTION, topics.MODEL_IDENTIFIED)
        }
        self._failed = node.create_publisher(String, topics.MODEL_FAILED, writer_qos(topics.MODEL))
        handlers: dict[Topic, Handler] = {
            topics.TARGET: responder.target,
            topics.START: responder.start,
            topics.POLICY: responder.policy,
            topics.MODEL: responder.model,
            topics.COST: responder.cost,
        }
        states = loop.receive(topics.STATE, self._on_state)
        self._fast_path: Any = None
        if FAST_PATH:
            self._fast_path = FAST_PATH.ControllerFastPath(responder, states.codec)
            loop.answer_fast(states, self._senders[topics.ACTION], self._fast_path)
        for topic, handler in handlers.items():
            loop.receive(topic, partial(self._on_other, handler))
        loop.receive(topics.PAUSED, self._on_paused)
        loop.introspection.report("responder", self._report)

    def _on_state(self, frame: Frame) -> None:
        self._perform(self._responder.state(frame))
        if self._fast_path:
            self._fast_path.last_state = frame

    def _on_other(self, handler: Handler, frame: Frame) -> None:
        self._perform(handler(frame))

    def _perform(self, sends: Sequence[Publication | ModelFailure]) -> None:
        for send in sends:
            if isinstance(send, Publication):
                self._senders[send.topic].send(send.frame)
            else:
                self._failed.publish(String(data=send.to_json()))
                what = "the exploration must be repeated" if send.retry else "no reduced model"
                self._node.get_logger().error(f"{what}: {send.reason}", throttle_duration_sec=1.0)

    def _report(self, now: float) -> Status:
        self._diagnostics.plants = self._node.count_publishers(
            self._node.resolve_topic_name(topics.STATE.name)
        )
        return self._diagnostics.report(now)

    def _on_paused(self, frame: Frame) -> None:
        self._diagnostics.plant_paused = bool(frame.values.any())

    def run(self) -> int:
        self._loop.run(self._housekeeping)
        return 0

    def _housekeeping(self, now: float) -> None:
        if lacking := self._diagnostics.waiting(now):
            self._node.get_logger().warning(
                f"a state is waiting for its action; still missing: {', '.join(lacking)}",
                throttle_duration_sec=5.0,
            )


def main(args: list[str] | None = None) -> int:
    """Console script."""
    keep_on_this_machine()
    return node_main("controller_node", args, ControllerNode)


if __name__ == "__main__":
    sys.exit(main())
