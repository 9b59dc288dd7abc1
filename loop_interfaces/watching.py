"""Reads the states and actions of a loop without taking part in it: for recorders and observers.

The plant of this project publishes them together on `samples` (loop_interfaces.samples), which
costs the loop next to nothing. Of a plant that does not, each state and action is read by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rclpy.node import Node
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

from loop_interfaces.endpoints import raw_subscription, reader_qos, samples_qos, scoped
from loop_interfaces.samples import (
    ACTION_KIND,
    CLOCK_KIND,
    STATE_KIND,
    ClockOffset,
    clock_message,
    unpack,
)
from loop_interfaces.topics import ACTION, SAMPLES, SAMPLES_THROTTLED, STATE

SAMPLE_DEPTH = 4000
"""Single states or actions that wait for a reader: most of a second of the fastest loop."""
BUNDLE_DEPTH = 128
"""Bundles that wait for a reader: about as long."""
_SINGLES: dict[int, tuple[Any, str]] = {
    STATE_KIND: (Float64MultiArray, STATE.name),
    ACTION_KIND: (Float64MultiArray, ACTION.name),
    CLOCK_KIND: (Clock, "/clock"),
}


class Watcher:
    """The states and actions of one pair, as serialised messages with the time of their arrival.

    clock: also the times that go with the states of a bundle; single_clock: also those on /clock
    where nothing is bundled (once is enough for several pairs); throttled: of some episodes only, as
    many as people can see, where the plant offers that. `handles` are the subscriptions to wait for;
    they may change with `look`.
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
        self._bundles = self._subscribe(
            UInt8MultiArray,
            SAMPLES_THROTTLED if throttled else SAMPLES,
            samples_qos(BUNDLE_DEPTH),
        )
        self._singles: dict[int, Subscription] = {}
        self._state_topic = node.resolve_topic_name(scoped(namespace, STATE.name))
        self.handles: list[Any] = [self._bundles.handle]

    def look(self) -> bool:
        """Look at the graph, and read single samples if they are not bundled; whether that changed."""
        bundled = self._node.count_publishers(self._bundles.topic_name) > 0
        wanted = not bundled and self._node.count_publishers(self._state_topic) > 0
        if wanted == bool(self._singles):
            return False
        if wanted:
            depth = reader_qos(STATE, SAMPLE_DEPTH)
            self._singles = {k: self._subscribe(*_SINGLES[k], depth) for k in self._kinds}
        else:
            for subscription in self._singles.values():
                self._node.destroy_subscription(subscription)
            self._singles = {}
        self.handles = [s.handle for s in (self._bundles, *self._singles.values())]
        return True

    def drain(self) -> Iterator[tuple[int, int, bytes]]:
        """Kind, time of arrival (ns since the epoch) and CDR bytes of everything that has come in.

        Raises FrameError, after which it can be called again, for a bundle that is none.
        """
        for _ in range(BUNDLE_DEPTH):
            taken = self._bundles.handle.take_message(UInt8MultiArray, True)
            if taken is None:
                break
            sent, samples = unpack(taken[0])
            offset = self._offset.update(sent, taken[1]["received_timestamp"])
            for sample in samples:
                yield sample.kind, sample.stamp + offset, sample.raw
                if self._clock and (told := clock_message(sample.time)) is not None:
                    yield CLOCK_KIND, sample.stamp + offset, told
        for kind, subscription in self._singles.items():
            for _ in range(SAMPLE_DEPTH):
                taken = subscription.handle.take_message(_SINGLES[kind][0], True)
                if taken is None:
                    break
                yield kind, taken[1]["received_timestamp"], taken[0]

    def close(self) -> None:
        """Stop reading; the plant then keeps no samples for this one."""
        for subscription in (self._bundles, *self._singles.values()):
            self._node.destroy_subscription(subscription)
        self._singles, self.handles = {}, []

    def _subscribe(self, message_type: Any, name: str, qos: Any) -> Subscription:
        return raw_subscription(self._node, message_type, scoped(self._namespace, name), qos)
