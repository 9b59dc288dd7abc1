# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Endpoints of the loop's array topics: quality of service, senders and receivers of frames.

They hand serialised bytes to the middleware and take them from it, so that no per-element Python is
on the hot path. The receivers are driven by pdeloop.ros.node_loop.
"""

import importlib
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

from pdeloop.messages.frames import Frame
from pdeloop.messages.samples import AGE, NO_TIME, STATE_KIND, SampleBatch, TokenBucket
from pdeloop.messages.topics import READER_DEPTH, SAMPLES, SAMPLES_THROTTLED, WRITER_DEPTH, Topic

BATCH_HISTORY = 16
"""Batches of samples that their publisher stores for a subscriber which lost one."""


class NeverExecuted(CallbackGroup):
    """Entities of this group are never taken by an executor."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        return None


def raw_subscription(node: Node, message_type: Any, name: str, qos: QoSProfile) -> Subscription:
    """A subscription whose serialised messages its owner takes itself, whenever it likes."""
    return node.create_subscription(
        message_type,
        name,
        lambda _: None,  # never called: see NeverExecuted
        qos,
        callback_group=NeverExecuted(),
        raw=True,
    )


def writer_qos(topic: Topic) -> QoSProfile:
    """QoS of a publisher: reliable, so that it serves every kind of reader."""
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
        history=HistoryPolicy.KEEP_LAST,
        depth=WRITER_DEPTH,
    )


def reader_qos(topic: Topic, depth: int = READER_DEPTH) -> QoSProfile:
    """QoS of a subscriber: reliable if the topic is latched, else best effort.

    In lock-step nothing is gained by acknowledging states and actions: the plant repeats a state
    whose answer is missing long before the middleware would, and the acknowledgements cost as much
    processor time as the samples.
    """
    profile = writer_qos(topic)
    profile.depth = depth
    if not topic.latched:
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    return profile


def samples_qos(depth: int) -> QoSProfile:
    """QoS of the topic `samples`: reliable, because the protocol does not repeat it."""
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=depth
    )


def scoped(namespace: str, name: str) -> str:
    """`name` below `namespace`: absolute with a leading slash, else relative; empty: the node's own.

    A name with a leading slash stays as it is.
    """
    if name.startswith("/"):
        return name
    inner = namespace.strip("/")
    return ("/" if namespace.startswith("/") else "") + (f"{inner}/{name}" if inner else name)


class _BatchPublisher:
    """Publishes batches on one topic. open: whether it takes samples."""

    def __init__(self, node: Node, name: str) -> None:
        self._publisher = node.create_publisher(UInt8MultiArray, name, samples_qos(BATCH_HISTORY))
        self.batch = SampleBatch()
        self.open = False
        self._flushed = 0.0

    def add(self, kind: int, stamp: int, raw: bytes, simulated: float) -> None:
        if self.batch.add(kind, stamp, raw, simulated):
            self.flush()

    def flush(self) -> None:
        if self.batch.size:
            self._publisher.publish(self.batch.take(time.monotonic_ns()))
        self._flushed = time.monotonic()

    def poll(self, now: float) -> bool:
        """True if there are subscribers; publishes samples that have waited too long."""
        if now - self._flushed > AGE:
            self.flush()
        return self._publisher.get_subscription_count() > 0


class SampleBatcher:
    """Publishes all samples on `samples`, and those of some episodes on `samples_throttled`.

    Nothing is stored while there are no subscribers.

    Make it before the publisher of the states: a process that has discovered the states has
    then discovered the samples.
    timed: whether the time of each state is published on /clock.
    """

    def __init__(self, node: Node) -> None:
        self._full = _BatchPublisher(node, SAMPLES)
        self._throttled = _BatchPublisher(node, SAMPLES_THROTTLED)
        self._publishers = self._full, self._throttled
        self._rate = TokenBucket()
        self._viewers = False
        """True if `samples_throttled` has subscribers."""
        self.timed = False

    @property
    def wanted(self) -> bool:
        """True if any node reads samples of the current episode."""
        return self._full.open or self._throttled.open

    def begin(self, now: float) -> None:
        """An episode begins."""
        self._throttled.open = self._viewers and self._rate.admits(now)

    def show(self, raw: bytes | None) -> None:
        """From now on give viewers this episode in any case, beginning with the state `raw`."""
        if raw is not None and self._viewers and not self._throttled.open:
            self._throttled.batch.add(STATE_KIND, time.monotonic_ns(), raw, NO_TIME)
        self._throttled.open = self._viewers

    def add(self, kind: int, raw: bytes, simulated: float = NO_TIME) -> None:
        """Add a message to the next batch; simulated: the time of a state in s."""
        stamp = time.monotonic_ns()
        if self._full.open:
            self._full.add(kind, stamp, raw, simulated)
        if self._throttled.open:
            self._rate.use(len(raw))
            self._throttled.add(kind, stamp, raw, simulated)

    def reserve(self, records: np.ndarray, room: int) -> None:
        """Let compiled code add to the batches, until `commit`.

        records: two of messages.SAMPLE_BATCH; room: bytes that it may add when a batch should be sent.
        """
        for record, publisher in zip(records, self._publishers, strict=True):
            record["open"] = publisher.open
            if publisher.open:
                publisher.batch.reserve(record, room)

    def commit(self, records: np.ndarray, sizes: Sequence[int], count: int) -> None:
        """Compiled code has added `count` messages of each of the sizes."""
        for record, publisher in zip(records, self._publishers, strict=True):
            if publisher.open and publisher.batch.commit(record):
                publisher.flush()
        if self._throttled.open:
            for size in sizes:
                self._rate.use(size, count)

    def flush(self) -> None:
        """Publish what waits."""
        for publisher in self._publishers:
            publisher.flush()

    def poll(self, now: float) -> None:
        """Look for subscribers, and publish samples that have waited long. Call it regularly."""
        before = self._viewers
        self._full.open, self._viewers = (publisher.poll(now) for publisher in self._publishers)
        self._throttled.open = self._viewers and (self._throttled.open or not before)


class Sender:
    """Publishes frames on one topic, and passes them to the batcher."""

    def __init__(
        self, node: Node, topic: Topic, namespace: str = "", batcher: SampleBatcher | None = None
    ) -> None:
        self._batcher = batcher
        self._codec = topic.codec()
        self.publisher: Publisher = node.create_publisher(
            Float64MultiArray, scoped(namespace, topic.name), writer_qos(topic)
        )

        # Past rclpy's wrapper, which locks the handle and looks at the type of every message.
        self._publish: Callable[[bytes | bytearray], None] = self.publisher.handle.publish_raw

    def encoded(self, frame: Frame) -> bytes:
        """The message that `send` would publish."""
        return self._codec.encode(frame)

    def send(self, frame: Frame) -> None:
        raw = self._codec.encode_into_own(frame)
        self._publish(raw)
        batcher = self._batcher
        if batcher is not None and batcher.wanted:
            batcher.add(STATE_KIND, bytes(raw), frame.time if batcher.timed else NO_TIME)


class Receiver:
    """A subscription of one topic whose frames go to a callback."""

    def __init__(
        self, node: Node, topic: Topic, callback: Callable[[Frame], None], namespace: str = ""
    ) -> None:
        self.callback = callback
        self.codec = topic.codec()
        self.decode = self.codec.decode
        self.subscription = raw_subscription(
            node, Float64MultiArray, scoped(namespace, topic.name), reader_qos(topic)
        )
        self.name = self.subscription.topic_name
        self.handle = self.subscription.handle
        self.take = self.handle.take_message


def message_class(name: str) -> Any:
    """The class of a message type like 'std_msgs/msg/String'; None if it is not installed."""
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind, None)
    except ImportError:
        return None
