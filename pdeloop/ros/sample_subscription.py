# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reads the states and actions of a loop without taking part in it: for recorders and observers.

The plant of this project publishes them together on `samples` (pdeloop.messages.samples), which
costs the loop next to nothing. Of a plant that does not, each state and action is read by itself.
"""

from collections.abc import Iterator
from typing import Any

from rclpy.node import Node
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

from pdeloop.messages.samples import (
    ACTION_KIND,
    CLOCK_KIND,
    STATE_KIND,
    ClockOffset,
    arrival_time,
    clock_message,
    unpack,
)
from pdeloop.messages.topics import ACTION, SAMPLES, SAMPLES_THROTTLED, STATE
from pdeloop.ros.endpoints import raw_subscription, reader_qos, samples_qos, scoped

SAMPLE_DEPTH = 4000
"""Single states or actions that wait for a reader: most of a second of the fastest loop."""
BATCH_DEPTH = 512
"""Batches that wait for a reader: seconds of the fastest loop, for a batch is not repeated."""
_SINGLES: dict[int, tuple[Any, str]] = {
    STATE_KIND: (Float64MultiArray, STATE.name),
    ACTION_KIND: (Float64MultiArray, ACTION.name),
    CLOCK_KIND: (Clock, "/clock"),
}


class SerializedSubscription:
    """Takes serialised messages of one raw subscription, with the middleware's information on each.

    depth: the most that one `take` gives.
    """

    def __init__(self, subscription: Subscription, message_type: Any, depth: int) -> None:
        self.subscription = subscription
        self._take = subscription.handle.take_message
        self._type, self._depth = message_type, depth
        self._left: tuple[bytes, dict[str, Any]] | None = None
        self._until = 0
        """The time limit of the call that left it."""

    def take(self, until: int | None = None) -> Iterator[tuple[bytes, dict[str, Any]]]:
        """Take the received samples. until: only those that arrived by then (ns since the epoch).

        The first message that arrived later is kept for a call with a later time; or an earlier one,
        for then the clock has been set back.
        """
        left = self._left
        if left is not None:
            if until is not None and self._until <= until < left[1]["received_timestamp"]:
                return
            self._left = None
            yield left
        for _ in range(self._depth):
            taken = self._take(self._type, True)
            if taken is None:
                return
            if until is not None and taken[1]["received_timestamp"] > until:
                self._left, self._until = taken, until
                return
            yield taken


class SampleSubscription:
    """The states and actions of one pair, as serialised messages with the time of their arrival.

    clock: also the times that go with the states of a batch; single_clock: also those on /clock
    where there are no batches (once is enough for several pairs); throttled: of some episodes only, as
    many as people can see, where the plant offers that. `handles` are the subscriptions to wait for;
    they may change with `poll`.
    """

    def __init__(
        self,
        node: Node,
        namespace: str = "",
        *,
        clock: bool = False,
        single_clock: bool = False,
        throttled: bool = False,
    ) -> None:
        self._node, self._namespace, self._clock = node, namespace, clock
        self._kinds = (STATE_KIND, ACTION_KIND, *((CLOCK_KIND,) if single_clock else ()))
        self._offset = ClockOffset()
        name = SAMPLES_THROTTLED if throttled else SAMPLES
        depth = BATCH_DEPTH
        self._batches = self._subscribe(UInt8MultiArray, name, samples_qos(depth), depth)
        self._singles: dict[int, SerializedSubscription] = {}
        self._state_topic = node.resolve_topic_name(scoped(namespace, STATE.name))
        self.handles: list[Any] = [self._batches.subscription.handle]

    def poll(self) -> bool:
        """Inspect the graph, and read single samples if there are no batches; whether that changed."""
        batched = self._node.count_publishers(self._batches.subscription.topic_name) > 0
        wanted = not batched and self._node.count_publishers(self._state_topic) > 0
        if wanted == bool(self._singles):
            return False
        if wanted:
            qos = reader_qos(STATE, SAMPLE_DEPTH)
            self._singles = {
                k: self._subscribe(*_SINGLES[k], qos, SAMPLE_DEPTH) for k in self._kinds
            }
        else:
            for intake in self._singles.values():
                self._node.destroy_subscription(intake.subscription)
            self._singles = {}
        intakes = (self._batches, *self._singles.values())
        self.handles = [intake.subscription.handle for intake in intakes]
        return True

    def drain(self, until: int | None = None) -> Iterator[tuple[int, int, bytes]]:
        """Kind, time of arrival (ns since the epoch) and CDR bytes of everything that has come in.

        until: as of SerializedSubscription.take. Raises FrameError, after which it can be called
        again, for a batch that is none.
        """
        for batch, info in self._batches.take(until):
            sent, samples = unpack(batch)
            offset = self._offset.update(sent, info["source_timestamp"], info["received_timestamp"])
            for sample in samples:
                arrival = arrival_time(sample.stamp, offset)
                yield sample.kind, arrival, sample.raw
                if self._clock and (clock := clock_message(sample.time)) is not None:
                    yield CLOCK_KIND, arrival, clock
        for kind, intake in self._singles.items():
            for raw, info in intake.take(until):
                yield kind, info["received_timestamp"], raw

    def close(self) -> None:
        """Stop reading; the plant then keeps no samples for this one."""
        for intake in (self._batches, *self._singles.values()):
            self._node.destroy_subscription(intake.subscription)
        self._singles, self.handles = {}, []

    def _subscribe(
        self, message_type: Any, name: str, qos: Any, depth: int
    ) -> SerializedSubscription:
        name = scoped(self._namespace, name)
        return SerializedSubscription(
            raw_subscription(self._node, message_type, name, qos), message_type, depth
        )
