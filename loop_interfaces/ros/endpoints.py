"""Endpoints of the loop's array topics: quality of service, senders and receivers of frames.

They hand serialised bytes to the middleware and take them from it, so that no per-element Python is
on the hot path. The receivers are driven by loop_interfaces.ros.node_loop.
"""

from __future__ import annotations

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

from loop_interfaces.frames import ArrayCodec, Frame
from loop_interfaces.ros.rcl import publishes_where_it_is
from loop_interfaces.samples import AGE, NO_TIME, STATE_KIND, Allowance, SampleBatch
from loop_interfaces.topics import (
    READER_DEPTH,
    SAMPLES,
    SAMPLES_THROTTLED,
    WRITER_DEPTH,
    Topic,
)

KEPT = 16
"""Batches of samples that their writer keeps for a reader which lost one."""


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
    """What a publisher offers: reliable, so that it serves every kind of reader."""
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
        history=HistoryPolicy.KEEP_LAST,
        depth=WRITER_DEPTH,
    )


def reader_qos(topic: Topic, depth: int = READER_DEPTH) -> QoSProfile:
    """What a subscriber asks for: reliable if the topic is latched, else best effort.

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
    """Of the topic `samples`: reliable, for it is not repeated by the protocol."""
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


class _Outlet:
    """A topic of batches."""

    def __init__(self, node: Node, name: str) -> None:
        self._publisher = node.create_publisher(UInt8MultiArray, name, samples_qos(KEPT))
        self._publish = publishes_where_it_is(self._publisher)
        self.batch = SampleBatch()
        self._began = 0.0

    def flush(self) -> None:
        if self.batch.size:
            with self.batch.take(time.monotonic_ns()) as message:
                self._publish(message)
        self._began = time.monotonic()

    def look(self, now: float) -> bool:
        """Whether somebody listens; publishes what has waited for long."""
        if now - self._began > AGE:
            self.flush()
        return self._publisher.get_subscription_count() > 0


class SampleBatcher:
    """Publishes `samples` for those who record or learn, and some episodes on `samples_throttled`
    for those who look; nothing is kept while there are none.

    Make it before the publisher of the states: who knows of the states then knows of the samples.
    timed: whether the time of each state goes on /clock.
    """

    def __init__(self, node: Node) -> None:
        self._all, self._some = _Outlet(node, SAMPLES), _Outlet(node, SAMPLES_THROTTLED)
        self._allowance = Allowance()
        self._read = self._looked_at = self._shown = False
        self.wanted = self.timed = False

    def begin(self, now: float) -> None:
        """An episode begins: whether it is shown to those who look."""
        self._shown = self._looked_at and self._allowance.admits(now)
        self.wanted = self._read or self._shown

    def show(self, raw: bytes | None) -> None:
        """From now on show the episode in any case, beginning with the state `raw`."""
        if raw is not None and self._looked_at and not self._shown:
            self._some.batch.add(STATE_KIND, time.monotonic_ns(), raw, NO_TIME)
        self._shown = self._looked_at
        self.wanted = self._read or self._shown

    def add(self, kind: int, raw: bytes, simulated: float = NO_TIME) -> None:
        """Keep a message for the next batch. Call it only while `wanted`.

        simulated: the time of a state in s.
        """
        stamp = time.monotonic_ns()
        if self._read and self._all.batch.add(kind, stamp, raw, simulated):
            self._all.flush()
        if self._shown:
            self._allowance.use(len(raw))
            if self._some.batch.add(kind, stamp, raw, simulated):
                self._some.flush()

    def lend(self, records: np.ndarray, room: int) -> None:
        """Let compiled functions add to both batches, to be settled afterwards.

        records: two of messages.SAMPLE_BATCH; room: bytes that they may add when a batch should
        be sent.
        """
        for record, outlet, wanted in zip(records, self._outlets, self._open, strict=True):
            record["open"] = wanted
            if wanted:
                outlet.batch.lend(record, room)

    def settle(self, records: np.ndarray, sizes: Sequence[int], count: int) -> None:
        """They are done, and have added `count` messages of each of the sizes."""
        for record, outlet, wanted in zip(records, self._outlets, self._open, strict=True):
            if wanted and outlet.batch.settle(record):
                outlet.flush()
        if self._shown:
            for size in sizes:
                self._allowance.use(size, count)

    @property
    def _outlets(self) -> tuple[_Outlet, _Outlet]:
        return self._all, self._some

    @property
    def _open(self) -> tuple[bool, bool]:
        return self._read, self._shown

    def flush(self) -> None:
        """Publish what has been kept."""
        self._all.flush()
        self._some.flush()

    def look(self, now: float) -> None:
        """Now and then: whether somebody listens, and whether a batch has waited for long."""
        before = self._looked_at
        self._read, self._looked_at = self._all.look(now), self._some.look(now)
        self._shown = self._looked_at and (self._shown or not before)
        self.wanted = self._read or self._shown


class Sender:
    """Publishes frames on one topic; what it sends goes to the batcher, too."""

    def __init__(
        self, node: Node, topic: Topic, namespace: str = "", batcher: SampleBatcher | None = None
    ) -> None:
        self._batcher = batcher
        self._codec = ArrayCodec(topic.labels)
        self.publisher: Publisher = node.create_publisher(
            Float64MultiArray, scoped(namespace, topic.name), writer_qos(topic)
        )

        # Past rclpy's wrapper, which locks the handle and looks at the type of every message.
        self._publish: Callable[[bytes | bytearray], None] = self.publisher.handle.publish_raw

    def encoded(self, frame: Frame) -> bytes:
        """What `send` would publish."""
        return self._codec.encode(frame)

    def send(self, frame: Frame) -> None:
        raw = self._codec.encode_into_own(frame)
        self._publish(raw)
        batcher = self._batcher
        if batcher is not None and batcher.wanted:
            batcher.add(STATE_KIND, bytes(raw), frame.time if batcher.timed else NO_TIME)


class Receiver:
    """Takes frames from one topic and hands them to a callback.

    codec: decodes them.
    """

    def __init__(
        self,
        node: Node,
        topic: Topic,
        callback: Callable[[Frame], None],
        namespace: str = "",
    ) -> None:
        self.callback = callback
        self.codec = ArrayCodec(topic.labels)
        self.decode = self.codec.decode
        self.subscription = raw_subscription(
            node, Float64MultiArray, scoped(namespace, topic.name), reader_qos(topic)
        )
        self.name = self.subscription.topic_name
        self.handle = self.subscription.handle
        self.take = self.handle.take_message
