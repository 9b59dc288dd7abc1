"""bag_player: publishes a bag's messages over topics, as a ROS 2 node.

Publishes   what the bag holds: the recorded bytes, under the recorded names, types and quality of
            service, in the recorded time
Parameters  those of the recorded run, read-only, so that who watches can ask for them
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from loop_interfaces.isolation import keep_on_this_machine
from loop_interfaces.ros.introspection import NAMELESS
from loop_interfaces.ros.message_types import message_class
from loop_interfaces.ros.node_main import ConfigurationError, ros_node
from loop_interfaces.ros.observer import Observer
from pdeloop.bags.playback import Playback
from pdeloop.bags.reader import Bag
from pdeloop.domain import own_domain
from pdeloop.live import announced
from recorder_node.bag import Channel
from recorder_node.sources import DIAGNOSTICS, ROSOUT
from tuner_node.results import TRANSIENT

NAME = "bag_player"
LOOK_FOR = 2.5
"""Seconds in which a live loop in this domain is found."""
LOOK = 0.2
"""Seconds between two looks for one."""
UNKNOWN = 1.0
"""Seconds in which the name of a publisher's node should come."""
TICK = 0.005
"""Seconds between two looks at which messages are due."""
LINGER = 0.5
"""Seconds after the last message in which it arrives everywhere."""


class PlayerError(RuntimeError):
    """The bag is not played, or not further; the text says why and what to do."""


class PlayerNode:
    """Publishes the messages of one bag.

    wait: begin when somebody subscribes.
    """

    def __init__(
        self, node: Node, loop: Observer, bag: Bag, playback: Playback, *, wait: bool
    ) -> None:
        self._node, self._loop, self._playback, self._waiting = node, loop, playback, wait
        self._channels = bag.channels()
        self._publishers: dict[str, Publisher] = {}
        self._create_at = time.monotonic() + LOOK_FOR
        self._seen_at: float | None = None
        """Since when there is another publisher of one of the topics."""
        self._end_at: float | None = None
        for name, value in _recorded_parameters(bag).items():
            node.declare_parameter(name, value, ParameterDescriptor(read_only=True))
        loop.every(LOOK, self._look)
        loop.every(TICK, self._play)

    def _look(self) -> None:
        now = time.monotonic()
        self._refuse_company(now)
        if not self._publishers and now >= self._create_at and self._seen_at is None:
            self._create()

    def _create(self) -> None:
        for channel in self._channels:
            kind = message_class(channel.type)
            if kind is None:
                self._node.get_logger().warning(
                    f"{channel.topic} is not played: its type {channel.type} is not installed"
                )
                continue
            publisher = self._node.create_publisher(kind, channel.topic, _qos(channel))
            self._publishers[channel.topic] = publisher
        if not self._publishers:
            raise PlayerError("the bag holds nothing that can be published here")

    def _play(self) -> None:
        now, playback = time.monotonic(), self._playback
        if not self._publishers:
            return
        if self._waiting:
            self._waiting = not any(p.get_subscription_count() for p in self._publishers.values())
            return
        for message in playback.take(now):
            if message.topic in self._publishers:
                self._publishers[message.topic].publish(message.data)
        if playback.over:
            self._end_at = self._end_at or now + LINGER
            if now >= self._end_at:
                self._loop.stop("end")

    def _refuse_company(self, now: float) -> None:
        """A live loop must not be told what happened long ago."""
        for topic in (channel.topic for channel in self._channels):
            if topic in (DIAGNOSTICS.channel.topic, ROSOUT.channel.topic):
                continue  # every node publishes there
            if self._node.count_publishers(topic) <= (topic in self._publishers):
                continue
            others = [
                f"{info.node_namespace.rstrip('/')}/{info.node_name}"
                for info in self._node.get_publishers_info_by_topic(topic)
                if info.node_name not in (NAMELESS, NAME)
            ]
            self._seen_at = self._seen_at or now
            if not others and now - self._seen_at < UNKNOWN:
                return  # the name comes a little later than the publisher
            who = others[0] if others else "another node"
            raise PlayerError(
                f"{who} publishes {topic} in this ROS domain; a bag is not played beside a live loop, "
                "which would take its messages for its own. Stop that loop (what was killed is seen "
                "for 3 s more), or play in another ROS_DOMAIN_ID"
            )
        self._seen_at = None


def _recorded_parameters(bag: Bag) -> dict[str, Any]:
    """What defines the last run in the bag, as far as it knows: not its folders and the like."""
    *_, last = ({}, *bag.parameters().values())
    return {
        name: value
        for name, value in last.items()
        if name not in TRANSIENT and isinstance(value, str | bool | int | float)
    }


def _qos(channel: Channel) -> QoSProfile:
    return QoSProfile(
        depth=channel.depth,
        reliability=ReliabilityPolicy.RELIABLE
        if channel.reliable
        else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if channel.latched
        else DurabilityPolicy.VOLATILE,
    )


def play(
    path: Path,
    *,
    rate: float,
    again: bool,
    wait: bool,
    network: bool,
    tell: Callable[[str], None],
) -> int:
    """Play the bag at `path` in a domain of its own or ROS_DOMAIN_ID; the exit code."""
    bag = Bag(path)
    playback = Playback(bag, rate=rate, again=again)
    if not network:
        keep_on_this_machine()
    with own_domain() as domain, announced(domain, bag.path, network=network):
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        tell(f"play {bag.path} (ROS_DOMAIN_ID={domain}{', on the network' * network})")
        if wait:
            tell("  waiting for somebody who subscribes")
        try:
            arguments = ["--ros-args", "--disable-external-lib-logs"]
            with ros_node(NAME, arguments, Observer) as (node, loop):
                PlayerNode(node, loop, bag, playback, wait=wait)
                reason: str = loop.run()
        except ConfigurationError as error:
            raise PlayerError(str(error)) from error
    tell(
        f"  {playback.published} messages published"
        + ("" if reason == "end" else f", stopped by {reason}")
    )
    return 0 if reason == "end" else 130
