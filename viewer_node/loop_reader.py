"""Reads the topics of one pair into a view: on a timer, never woken by a message.

A loop of thousands of rounds a second would wake who waits for its messages as often, and take a
processor core from itself. So the subscriptions are polled: PERIOD is short enough for the depth of
the latched topics.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass

from rclpy.node import Node
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray

from loop_interfaces.frames import ArrayCodec, Frame
from loop_interfaces.ros.endpoints import raw_subscription, reader_qos, scoped
from loop_interfaces.ros.sample_subscription import SampleSubscription
from loop_interfaces.samples import ACTION_KIND, STATE_KIND
from loop_interfaces.topics import ACTION, COST, MODEL, PAUSED, POLICY, START, STATE, TARGET, Topic
from viewer_node.loop_view import LoopView

PERIOD = 0.03
"""Seconds between two reads."""
Handler = Callable[[Frame, float], None]
"""Called with a frame and the time (monotonic s)."""


class LoopReader:
    """Subscribes to what a view shows: the latched topics, and the samples while `listen` says so.

    namespace: of the pair; empty: the node's own.
    """

    def __init__(self, node: Node, namespace: str, view: LoopView) -> None:
        self._node, self._namespace = node, namespace
        handlers: dict[Topic, Handler] = {
            TARGET: view.target,
            MODEL: view.model,
            POLICY: view.policy,
            START: view.start,
            PAUSED: view.paused,
        }
        self._latched = [self._subscribe(topic, handle) for topic, handle in handlers.items()]
        self._costs = self._subscribe(COST, view.cost)
        self._samples: SampleSubscription | None = None
        self._handlers: dict[int, tuple[Callable[[bytes], Frame], Handler]] = {
            STATE_KIND: (ArrayCodec(STATE.labels).decode, view.state),
            ACTION_KIND: (ArrayCodec(ACTION.labels).decode, view.action),
        }

    def listen(self, yes: bool) -> None:
        """Whether states and actions are read, too: each costs their sender something."""
        if yes and self._samples is None:
            self._samples = SampleSubscription(self._node, self._namespace, throttled=True)
            self._samples.poll()
        elif not yes and self._samples is not None:
            self._samples.close()
            self._samples = None

    def poll_graph(self) -> None:
        """Subscribe to the samples where they are published; call it about once a second."""
        if self._samples is not None:
            self._samples.poll()

    def read(self) -> None:
        """Hand on what has come in.

        Taken in one order and handled in another: when a cost has come in, so have all samples of
        its episode, and its start.
        """
        costs = self._costs.take()
        for topic in self._latched:
            topic.handle(topic.take())
        now = time.monotonic()
        if self._samples is not None:
            with contextlib.suppress(ValueError):  # the loop's nodes report what they refuse
                for kind, _, raw in self._samples.drain():
                    if kind in self._handlers:
                        decode, handle = self._handlers[kind]
                        with contextlib.suppress(ValueError):
                            handle(decode(raw), now)
        self._costs.handle(costs)

    def close(self) -> None:
        """Stop reading."""
        self.listen(False)
        for topic in (*self._latched, self._costs):
            self._node.destroy_subscription(topic.subscription)

    def _subscribe(self, topic: Topic, handle: Handler) -> _Latched:
        name = scoped(self._namespace, topic.name)
        subscription = raw_subscription(self._node, Float64MultiArray, name, reader_qos(topic))
        return _Latched(subscription, ArrayCodec(topic.labels).decode, handle)


@dataclass(frozen=True)
class _Latched:
    """A latched topic of arrays."""

    subscription: Subscription
    decode: Callable[[bytes], Frame]
    handler: Handler

    def take(self) -> list[bytes]:
        """What has come in."""
        take, found = self.subscription.handle.take_message, []
        while (taken := take(Float64MultiArray, True)) is not None:
            found.append(taken[0])
        return found

    def handle(self, messages: list[bytes]) -> None:
        """Hand messages on."""
        now = time.monotonic()
        for raw in messages:
            with contextlib.suppress(ValueError):
                self.handler(self.decode(raw), now)
