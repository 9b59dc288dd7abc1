# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Fast paths of a plant and a controller on real topics; for tests/topics/test_fast_path.py."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import rclpy
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

from pdeloop.fast_path.channel import CAPACITY, LARGE
from pdeloop.messages.frames import HEADER
from pdeloop.messages.samples import ACTION_KIND, NO_TIME, STATE_KIND, unpack
from pdeloop.messages.topics import ACTION, COST, STATE, VOID, CostColumn
from pdeloop.ros.endpoints import raw_subscription, samples_qos
from pdeloop.ros.node_loop import NodeLoop
from pdeloop.ros.sample_subscription import SerializedSubscription
from tests.support.fast_path_pair import Controller, Plant, with_number
from tests.support.loop_harness import until

LIMIT = 60.0
"""Seconds for each wait, on a busy machine."""


class Peer:
    """Publishes messages of one kind, and reads those of the other.

    channel: of the fast path that its messages come to.
    """

    def __init__(self, sends: str, reads: str, channel: Any) -> None:
        self._channel = channel
        self.node = rclpy.create_node("peer")
        self._publisher = self.node.create_publisher(Float64MultiArray, sends, 10)
        self._intake = self._reader(Float64MultiArray, reads, 10)

    def _reader(self, kind: Any, name: str, depth: int) -> SerializedSubscription:
        subscription = raw_subscription(self.node, kind, name, samples_qos(depth))
        return SerializedSubscription(subscription, kind, depth)

    def watch(self) -> None:
        self._batches = self._reader(UInt8MultiArray, "samples", 50)

    def meet(self, *topics: str) -> None:
        """Wait until everybody knows of everybody."""
        until(
            lambda: (
                self._publisher.get_subscription_count()
                and all(self.node.count_publishers(topic) for topic in topics)
            ),
            LIMIT,
            "peer",
        )
        time.sleep(0.3)

    def say(self, *messages: bytes) -> None:
        """Publish, and wait until all have come to the channel."""
        before = self._arrived()
        for raw in messages:
            self._publisher.publish(raw)
        until(lambda: self._arrived() == before + len(messages), LIMIT, "arrival of the messages")

    def say_to_nobody(self, raw: bytes) -> None:
        self._publisher.publish(raw)
        time.sleep(0.2)

    def _arrived(self) -> int:
        record = self._channel.record[0]
        return sum(int(record[name]) for name in ("answered", "waiting", "dropped"))

    def heard(self, count: int, intake: SerializedSubscription | None = None) -> list[bytes]:
        deadline, got = time.monotonic() + LIMIT, []
        while len(got) < count and time.monotonic() < deadline:
            got += [bytes(raw) for raw, _ in (intake or self._intake).take()]
            time.sleep(0.002)
        return got

    def samples(self) -> list[Any]:
        time.sleep(0.2)
        return [s for raw in self.heard(1, self._batches) for s in unpack(raw)[1]]


@contextmanager
def opened(loop: NodeLoop, receiver: Any, sender: Any, path: Any) -> Iterator[None]:
    assert path.channel.open(receiver.handle, sender.publisher.handle, loop._guard)
    try:
        yield
    finally:
        path.channel.close()


def answer_for(path: Any, seconds: float = 0.0, messages: int = 0) -> bytes | None:
    """Be armed until so many messages were answered or one waits, but not longer; the one that waits.

    Without a time: answer what waits already.
    """
    if path.arm():
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and not path.channel.waits:
            if messages and path.channel.record[0]["answered"] >= messages:
                break
            time.sleep(0.002)
        path.disarm()
    waiting: bytes | None = path.channel.next_message()
    return waiting


def plant_on_topics(*, timed: bool = False) -> None:
    node = rclpy.create_node("plant")
    loop = NodeLoop(node)
    loop.batcher.timed = timed
    plant = Plant(loop.batcher, horizon=14)
    path = plant.path
    peer = Peer("action", "state", path.channel)
    receiver = loop.receive(ACTION, lambda frame: None)
    sender = loop.sender(STATE, sampled=True)
    with opened(loop, receiver, sender, path):
        peer.meet("state")
        state = plant.begin(1, (3, 4))
        plant.expected(first := plant.action(state))
        peer.say(first)
        assert answer_for(path) == first  # nothing is known of the peer's messages yet
        state = plant.ordinary(first)
        actions, states = [], []

        def next_action() -> bytes:
            nonlocal state
            actions.append(raw := plant.action(state))
            _, state = plant.expected(raw)
            states.append(plant.sent.encode(state))
            return raw

        # Those that wait already, one and several, and one that comes meanwhile.
        for count in (1, 3):
            peer.say(*[next_action() for _ in range(count)])
            assert answer_for(path) is None
        assert plant.lockstep.step == plant.judge.step == 5
        assert not plant.lockstep.plant.parallel.shared
        for _ in range(2):
            assert path.arm()
            peer.say(next_action())
            assert path.disarm() == 1
        assert peer.heard(6) == states
        assert plant.lockstep.step == plant.judge.step == 7

        # Nothing else is taken, and everything else is left to be handled, in its order.
        good = plant.action(state)
        bads = [
            with_number(good, 8, place, number)
            for place, number in (
                (0, 1.0), (1, 2.0), (2, 6.0), (4, 78.0), (HEADER, np.nan), (-1, np.inf),
            )
        ]  # fmt: skip
        for bad in bads:
            assert path.arm()
            peer.say(bad, bad[:-8])
            path.disarm()
            assert [path.channel.next_message() for _ in range(3)] == [bad, bad[:-8], None]
        for bad in (good[:-8], good + bytes(8), good.replace(b"env", b"enw", 1)):
            peer.say(bad)
            assert answer_for(path, 1.0) == bad
        peer.say(bad := good + bytes(2 * LARGE))
        assert (answer_for(path, 1.0) or b"")[: len(bad)] == bad
        assert all(slot.capacity <= LARGE for slot in path.channel._slots)
        assert plant.lockstep.step == 7
        # The next one, an old one again, and one that comes when the old one waits.
        _, state = plant.expected(good)
        later = plant.action(state)
        assert path.arm()
        peer.say(good, actions[-1], later)
        assert path.disarm() == 1
        assert [path.channel.next_message() for _ in range(3)] == [actions[-1], later, None]
        assert peer.heard(1) == [plant.sent.encode(state)]

        # For those who record.
        peer.watch()
        while not loop.batcher.wanted:
            loop.batcher.poll(loop.now())
        time.sleep(0.3)
        sent, told = [], []
        for _ in range(3):
            raw = next_action()
            sent.append((ACTION_KIND, raw, NO_TIME))
            sent.append((STATE_KIND, states[-1], state.time if timed else NO_TIME))
            peer.say(raw)
            before = time.monotonic_ns()
            assert answer_for(path) is None
            told.append((before, time.monotonic_ns()))
        loop.batcher.flush()
        got = peer.samples()
        assert [(s.kind, s.raw, s.time) for s in got] == sent
        for i, (before, after) in enumerate(told):
            assert before <= got[2 * i].stamp <= got[2 * i + 1].stamp <= after
        assert peer.heard(3) == states[-3:]
        # A batch that should be sent is, before it takes more.
        path.prepare()
        path.plan["batches"]["limit"] = path.plan["batches"]["end"]
        path.channel.arm()
        peer.say(full := plant.action(state))
        path.channel.disarm()
        assert path.channel.next_message() == full

        # What the mailbox cannot hold is counted.
        many = [with_number(good, 8, -1, float(i)) for i in range(CAPACITY + 3)]
        for raw in many:
            peer.say(raw)
        assert path.channel.newly_dropped() == 3
        assert path.channel.newly_dropped() == 0
        assert [path.channel.next_message() for _ in range(CAPACITY + 1)] == [
            *many[:CAPACITY],
            None,
        ]

        # Up to the last state, never its answer.
        while plant.lockstep.step < plant.lockstep.plant.horizon:
            peer.say(next_action())
            assert answer_for(path) is None
        peer.say(last := plant.action(state))
        assert answer_for(path) == last
        for name in ("steps_total", "rounds_total", "time", "step", "counters"):
            assert getattr(plant.lockstep, name) == getattr(plant.judge, name), name
        (cost,) = plant.lockstep.action(plant.own.decode(last), 0.0)
        topic, expected = plant.expected(last)
        assert topic is COST and cost.topic is COST
        assert cost.frame.values.tobytes() == expected.values.tobytes()

        # What was taken is remembered: another answer to the same state voids the episode.
        state = plant.begin(2, (5, 6))
        peer.say(raw := plant.action(state))
        assert answer_for(path) is None
        assert plant.lockstep.step == 1
        assert plant.lockstep.action(plant.own.decode(raw), 0.0) == []
        other = with_number(raw, 8, -1, 0.123)
        (void,) = plant.lockstep.action(plant.own.decode(other), 0.0)
        assert (void.frame.values[:, CostColumn.ENDED] == VOID).all()
    node.destroy_node()
    peer.node.destroy_node()


def controller_on_topics() -> None:
    node = rclpy.create_node("controller")
    loop, controller = NodeLoop(node), Controller(3)
    path, responder = controller.path, controller.responder
    peer = Peer("state", "action", path.channel)
    receiver = loop.receive(STATE, lambda frame: None)
    with opened(loop, receiver, loop.sender(ACTION), path):
        peer.meet("action")
        controller.begin(4)
        peer.say(first := controller.state(4, 0))
        assert answer_for(path) == first
        controller.ordinary(first)
        states = [controller.state(4, step) for step in range(1, 6)]
        peer.say(*states)
        assert answer_for(path) is None
        assert peer.heard(5) == [controller.expected(raw) for raw in states]
        assert (responder.answered, responder.step) == (6, 5)
        assert path.arm()
        peer.say(states[2], other := controller.state(5, 0))  # asked again; and another episode
        assert path.disarm() == 1
        assert path.channel.next_message() == other
        assert peer.heard(1) == [controller.expected(states[2])]
        assert (responder.answered, responder.step) == (7, 3)
    # Closed, it hears nothing any more.
    peer.say_to_nobody(controller.state(4, 6))
    assert path.arm()
    assert path.disarm() == 0
    assert not path.channel.waits
    node.destroy_node()
    peer.node.destroy_node()


if __name__ == "__main__":
    rclpy.init()
    controller_on_topics()
    plant_on_topics()
    plant_on_topics(timed=True)
    rclpy.shutdown()
    print("done")
