# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reads the topics of one pair into a view: on a timer, never woken by a message.

A loop of thousands of rounds a second would wake who waits for its messages as often, and take a
processor core from itself. So the subscriptions are polled: PERIOD is short enough for the depth of
the latched topics.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from pdeloop.messages.frames import ArrayCodec, Frame
from pdeloop.messages.samples import ACTION_KIND, STATE_KIND
from pdeloop.messages.topics import ACTION, COST, MODEL, PAUSED, POLICY, START, STATE, TARGET, Topic
from pdeloop.ros.endpoints import raw_subscription, reader_qos, scoped
from pdeloop.ros.sample_subscription import SampleSubscription, SerializedSubscription
from viewer_node.loop_view import LoopView

PERIOD = 0.03
"""Seconds between two reads."""
Decoder = Callable[[bytes], Frame]
Handler = Callable[[Frame, float], None]
"""Called with a frame and the time (monotonic s)."""


class LoopReader:
    """Subscribes to what a view shows: the latched topics, and the samples while `listen` is true.

    namespace: of the pair; empty: the node's own. What is read goes to the view.
    """

    def __init__(self, node: Node, namespace: str, view: LoopView) -> None:
        self._node, self._namespace = node, namespace
        handlers: dict[Topic, Handler] = {
            TARGET: view.target,
            MODEL: view.model,
            POLICY: view.policy,
            START: view.start,
            PAUSED: view.paused,
            COST: view.cost,
        }
        self._topics: list[tuple[SerializedSubscription, Decoder, Handler]] = []
        for topic, handle in handlers.items():
            name, qos = scoped(namespace, topic.name), reader_qos(topic)
            raw = raw_subscription(node, Float64MultiArray, name, qos)
            taken = SerializedSubscription(raw, Float64MultiArray, qos.depth)
            self._topics.append((taken, topic.codec().decode, handle))
        self._samples: SampleSubscription | None = None
        self._handlers: dict[int, tuple[Decoder, Handler]] = {
            STATE_KIND: (ArrayCodec(STATE.labels).decode, view.state),
            ACTION_KIND: (ArrayCodec(ACTION.labels).decode, view.action),
        }

    def listen(self, yes: bool) -> None:
        """True while states and actions are read as well: each reader costs their sender something."""
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
        now, costs = time.monotonic(), list(self._topics[-1][0].take())
        for topic, decode, handle in self._topics[:-1]:
            for raw, _ in topic.take():
                _hand_on(raw, decode, handle, now)
        if self._samples is not None:
            with contextlib.suppress(ValueError):  # the loop's nodes report what they refuse
                for kind, _, raw in self._samples.drain():
                    if kind in self._handlers:
                        _hand_on(raw, *self._handlers[kind], now)
        for raw, _ in costs:
            _hand_on(raw, *self._topics[-1][1:], now)

    def close(self) -> None:
        """Stop reading."""
        self.listen(False)
        for topic, _, _ in self._topics:
            self._node.destroy_subscription(topic.subscription)


def _hand_on(raw: bytes, decode: Decoder, handle: Handler, now: float) -> None:
    with contextlib.suppress(ValueError):
        handle(decode(raw), now)
