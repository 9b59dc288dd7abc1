"""bag_player: publishes a bag's messages over topics, as a ROS 2 node.

Publishes   what the bag holds: the recorded bytes, under the recorded names, types and quality of
            service, in the recorded time
Parameters  those of the recorded run, read-only, so that who watches can ask for them
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from loop_interfaces.isolation import keep_on_this_machine
from loop_interfaces.ros.introspection import full_name
from loop_interfaces.ros.message_types import message_class
from loop_interfaces.ros.node_main import ConfigurationError, ros_node
from loop_interfaces.ros.observer import Observer
from pdeloop.bags.mcap_messages import Message
from pdeloop.bags.reader import Bag
from pdeloop.domain import own_domain
from pdeloop.live import announced
from recorder_node.bag import BagError, Channel
from recorder_node.sources import DIAGNOSTICS, ROSOUT
from tuner_node.results import TRANSIENT

NAME = "bag_player"
LOOK_FOR = 2.5
"""Seconds in which a live loop in this domain is found."""
SETTLE = 1.0
"""Seconds in which publishers are found before the first message, and the last one arrives."""
TICK = 0.005
"""Seconds between two rounds in which the messages that are due are published."""


def timed(
    messages: Callable[[], Iterable[Message]], rate: float, again: bool = False
) -> Iterator[tuple[float, Message]]:
    """Each message, and when it is due: seconds after the first one, at `rate` times the speed.

    again: begin anew at the end, for ever.
    """
    begun = 0.0
    while True:
        first, due = None, begun
        for message in messages():
            first = message.when if first is None else first
            due = begun + (message.when - first) / 1e9 / rate
            yield due, message
        if first is None or not again:
            return
        begun = due


class PlayerNode:
    """Publishes the messages of one bag, where no live loop would take them for its own."""

    def __init__(self, node: Node, loop: Observer, bag: Bag, rate: float, again: bool) -> None:
        self._node, self._loop, self._channels = node, loop, bag.channels()
        self._publishers: dict[str, Publisher] = {}
        self.published = 0
        *_, parameters = ({}, *bag.parameters().values())
        for name, value in parameters.items():
            if name not in TRANSIENT and isinstance(value, str | bool | int | float):
                node.declare_parameter(name, value, ParameterDescriptor(read_only=True))
        self._messages = timed(bag.messages, rate, again)
        self._next = next(self._messages, None)
        if self._next is None:
            raise BagError(f"{bag.path} holds no messages")
        self._begin = loop.now() + LOOK_FOR + SETTLE
        self._end = float("inf")
        loop.every(TICK, self._play)

    def _play(self) -> None:
        elapsed = self._loop.now() - self._begin
        if not self._publishers and elapsed > -SETTLE:
            self._refuse_beside_a_loop()
            self._create()
        while self._next is not None and self._next[0] <= elapsed:
            message = self._next[1]
            if message.topic in self._publishers:
                self._publishers[message.topic].publish(message.data)
            self.published += 1
            self._next = next(self._messages, None)
            self._end = elapsed + SETTLE
        if self._next is None and elapsed > self._end:
            self._loop.stop("end")

    def _create(self) -> None:
        for channel in self._channels:
            if (kind := message_class(channel.type)) is None:
                self._node.get_logger().warning(
                    f"{channel.topic} is not played: its type {channel.type} is not installed"
                )
                continue
            publisher = self._node.create_publisher(kind, channel.topic, _qos(channel))
            self._publishers[channel.topic] = publisher
        if not self._publishers:
            raise ConfigurationError("the bag holds nothing that can be published here")

    def _refuse_beside_a_loop(self) -> None:
        """A live loop would take the recorded messages for its own."""
        of_every_node = (DIAGNOSTICS.channel.topic, ROSOUT.channel.topic)
        for topic in {channel.topic for channel in self._channels}.difference(of_every_node):
            for info in self._node.get_publishers_info_by_topic(topic):
                raise ConfigurationError(
                    f"{full_name(info)} publishes {topic} in this ROS "
                    "domain; a bag is not played beside a live loop, which would take its messages for "
                    "its own. Stop that loop (what was killed is seen for 3 s more), or play in "
                    "another ROS_DOMAIN_ID"
                )


def _qos(channel: Channel) -> QoSProfile:
    reliable, latched = ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL
    return QoSProfile(
        depth=channel.depth,
        reliability=reliable if channel.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=latched if channel.latched else DurabilityPolicy.VOLATILE,
    )


def play(
    path: Path, *, rate: float, again: bool, network: bool, tell: Callable[[str], None]
) -> int:
    """Play the bag at `path` in a domain of its own or ROS_DOMAIN_ID; the exit code."""
    bag = Bag(path)
    if not network:
        keep_on_this_machine()
    with own_domain() as domain, announced(domain, bag.path, network=network):
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        tell(f"play {bag.path} (ROS_DOMAIN_ID={domain}{', on the network' * network})")
        arguments = ["--ros-args", "--disable-external-lib-logs"]
        with ros_node(NAME, arguments, Observer) as (node, loop):
            player = PlayerNode(node, loop, bag, rate, again)
            reason: str = loop.run()
    stopped = "" if reason == "end" else f", stopped by {reason}"
    tell(f"  {player.published} messages published{stopped}")
    return 0 if reason == "end" else 130
