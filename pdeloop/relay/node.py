"""relay_node: sits on the state and action topics between a plant and a controller.

Start the plant with `-r state:=state_sent` and the controller with `-r action:=action_sent`; the
relay passes state_sent on to state and action_sent on to action, with faults.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from loop_interfaces.isolation import keep_on_this_machine
from loop_interfaces.ros.endpoints import reader_qos, writer_qos
from loop_interfaces.ros.node_loop import NodeLoop
from loop_interfaces.ros.node_main import node_main
from loop_interfaces.ros.parameters import declare
from loop_interfaces.spec import Spec
from loop_interfaces.topics import ACTION, STATE
from pdeloop.relay.faults import Faults, FaultyLine

PARAMETERS = (
    Spec("loss", 0.0, "probability that a message is lost", 0.0, 0.99),
    Spec("duplicate", 0.0, "probability that a message is sent twice", 0.0, 1.0),
    Spec("delay", 0.0, "largest delay of a message; smaller ones overtake", 0.0, 10.0, unit="s"),
    Spec("seed", 0, "seed of the faults", 0, 2**31 - 1),
)


class RelayNode:
    """Passes raw messages on; it never looks into them."""

    def __init__(self, node: Node, loop: NodeLoop) -> None:
        given = {name: value.value for name, value in node._parameter_overrides.items()}
        values = declare(node, PARAMETERS, given)
        faults = Faults(values["loss"], values["duplicate"], values["delay"])
        self._faults, self._seed = faults, values["seed"]
        self._wire(node, loop)

    def join(self, node: Node, loop: NodeLoop) -> None:
        self._wire(node, loop)

    def _wire(self, node: Node, loop: NodeLoop) -> None:
        self._node, self._loop = node, loop
        self._lines = []
        for number, topic in enumerate((STATE, ACTION)):
            subscription = node.create_subscription(
                Float64MultiArray,
                f"{topic.name}_sent",
                lambda _: None,
                reader_qos(topic, 100),
                raw=True,
            )
            publisher = node.create_publisher(Float64MultiArray, topic.name, writer_qos(topic))
            line = FaultyLine(self._faults, np.random.default_rng([self._seed, number]))
            self._lines.append((subscription, publisher, line))

    def run(self) -> int:
        """Pass messages on until stopped; says at the end what it did."""
        wait_set = _rclpy.WaitSet(len(self._lines), 0, 0, 0, 0, 0, self._node.context.handle)
        while not self._loop.stopped:
            now = time.monotonic()
            due = [line.next_due for _, _, line in self._lines if line.next_due is not None]
            wait_set.clear_entities()
            for subscription, _, _ in self._lines:
                wait_set.add_subscription(subscription.handle)
            wait_set.wait(int(1e9 * max(0.0, min([0.05, *(d - now for d in due)]))))
            for subscription, publisher, line in self._lines:
                while taken := subscription.handle.take_message(Float64MultiArray, True):
                    line.put(taken[0], time.monotonic())
                for message in line.due(time.monotonic()):
                    publisher.publish(message)
        for (_, _, line), name in zip(self._lines, ("state", "action"), strict=True):
            self._node.get_logger().info(
                f"{name}: {line.passed} passed, {line.lost} lost, {line.duplicated} duplicated"
            )
        return 0


def main(args: list[str] | None = None) -> int:
    """Run by `python -m pdeloop.relay.node`."""
    keep_on_this_machine()
    return node_main("relay_node", args, RelayNode)


if __name__ == "__main__":
    sys.exit(main())
