"""Endpoints of the loop's array topics: quality of service, senders and receivers of frames.

They hand serialised bytes to the middleware and take them from it, so that no per-element Python is
on the hot path. The receivers are driven by loop_interfaces.node_loop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray

from loop_interfaces.frames import ArrayCodec, Frame
from loop_interfaces.topics import READER_DEPTH, WRITER_DEPTH, Topic

OBSERVER_DEPTH = 2000
"""Samples that may wait for an observer that was not scheduled for a while."""


class OutsideExecutor(CallbackGroup):
    """Entities of this group are never taken by an executor."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        return None


def qos(topic: Topic, depth: int) -> QoSProfile:
    """The quality of service of a topic; always reliable, so that only a dying peer loses data.

    depth: WRITER_DEPTH or READER_DEPTH, or more for a recorder.
    """
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
    )


def observer_qos(topic: Topic) -> QoSProfile:
    """For who watches states and actions: their writers keep one sample, so a lost one could not be
    sent again, and acknowledgements would slow the loop.
    """
    profile = qos(topic, OBSERVER_DEPTH)
    profile.reliability = ReliabilityPolicy.BEST_EFFORT
    return profile


def scoped(namespace: str, name: str) -> str:
    """`name` below the relative `namespace` (empty: the node's own)."""
    return f"{namespace.strip('/')}/{name}" if namespace.strip("/") else name


class Sender:
    """Publishes frames on one topic."""

    def __init__(self, node: Node, topic: Topic, namespace: str = "") -> None:
        self._codec = ArrayCodec(topic.labels)
        self.publisher: Publisher = node.create_publisher(
            Float64MultiArray, scoped(namespace, topic.name), qos(topic, WRITER_DEPTH)
        )

        # Past rclpy's wrapper, which locks the handle and looks at the type of every message.
        self._publish = self.publisher.handle.publish_raw

    def send(self, frame: Frame) -> None:
        self._publish(self._codec.encode_into_own(frame))


class Receiver:
    """Takes frames from one topic and hands them to a callback."""

    def __init__(
        self,
        node: Node,
        topic: Topic,
        callback: Callable[[Frame], None],
        namespace: str,
        *,
        observer: bool = False,
    ) -> None:
        self.callback = callback
        self.observer = observer
        self.decode = ArrayCodec(topic.labels).decode
        self.subscription: Subscription = node.create_subscription(
            Float64MultiArray,
            scoped(namespace, topic.name),
            lambda _: None,  # never called: see OutsideExecutor
            observer_qos(topic) if observer else qos(topic, READER_DEPTH),
            callback_group=OutsideExecutor(),
            raw=True,
        )
        self.handle = self.subscription.handle
        self.take = self.handle.take_message
