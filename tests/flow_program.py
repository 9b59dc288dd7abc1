"""Flows of a plant and a controller on real topics, against the long way; for topics/test_flow.py."""

from __future__ import annotations

import time
from threading import Timer
from typing import Any

import numpy as np
import rclpy
from std_msgs.msg import Float64MultiArray, UInt8MultiArray

from loop_interfaces.fast_path.line import Doorbell, Ear, Line
from loop_interfaces.frames import HEADER
from loop_interfaces.protocol import MORE, OTHER, QUIET, UNABLE
from loop_interfaces.ros.endpoints import raw_subscription, samples_qos
from loop_interfaces.ros.node_loop import NodeLoop
from loop_interfaces.ros.sample_subscription import Intake
from loop_interfaces.samples import ACTION_KIND, NO_TIME, STATE_KIND, unpack
from loop_interfaces.topics import ACTION, COST, STATE, VOID, CostColumn
from pde_sim_node.solver import workers
from tests.test_reflexes import Controller, Plant, with_number

LONG, SHORT = 10**9, 5 * 10**7  # ns


class Peer:
    """Publishes messages of one kind, and reads those of the other."""

    def __init__(self, sends: str, reads: str) -> None:
        self.node = rclpy.create_node("peer")
        self._publisher = self.node.create_publisher(Float64MultiArray, sends, 10)
        self._intake = self._reader(Float64MultiArray, reads, 10)

    def _reader(self, kind: Any, name: str, depth: int) -> Intake:
        subscription = raw_subscription(self.node, kind, name, samples_qos(depth))
        return Intake(subscription, kind, depth)

    def watch(self) -> None:
        self._bundles = self._reader(UInt8MultiArray, "samples", 50)

    def meet(self, *topics: str) -> None:
        """Wait until everybody knows of everybody."""
        deadline = time.monotonic() + 20.0
        while self._publisher.get_subscription_count() < 1 or not all(
            self.node.count_publishers(topic) for topic in topics
        ):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        time.sleep(0.3)

    def say(self, *messages: bytes) -> None:
        for raw in messages:
            self._publisher.publish(raw)
        time.sleep(0.05)  # until they are there

    def heard(self, count: int, intake: Intake | None = None) -> list[bytes]:
        deadline, got = time.monotonic() + 5.0, []
        while len(got) < count and time.monotonic() < deadline:
            got += [bytes(raw) for raw, _ in (intake or self._intake).take()]
            time.sleep(0.002)
        return got

    def samples(self) -> list[Any]:
        time.sleep(0.2)
        return [s for raw in self.heard(1, self._bundles) for s in unpack(raw)[1]]


def line_of(loop: NodeLoop, receiver: Any, sender: Any, ear: Ear, opened: bool = True) -> Line:
    line = Line(loop.node, receiver.handle, sender.publisher.handle, loop._guard, ear)
    if opened:  # else the thread that attends deals with everything itself
        line.open()
    return line


def plant_flows(
    *, opened: bool = True, timed: bool = False, helped: bool = False, **overrides: object
) -> None:
    node = rclpy.create_node("plant")
    loop, plant, peer = NodeLoop(node), Plant(horizon=12, **overrides), Peer("action", "state")
    loop.bundler.timed = timed
    receiver = loop.receive(ACTION, lambda frame: None, bundled=True)
    sender = loop.sender(STATE, bundled=True)
    line = line_of(loop, receiver, sender, plant.reflex.ear, opened)

    def flow(rounds: int, patience: int) -> tuple[int, int]:
        return plant.reflex.flow(loop.bundler, rounds, time.monotonic_ns() + patience)

    peer.meet("state")

    state = plant.begin(1, (3, 4))
    assert bool(plant.lockstep.machine.board) == helped
    assert flow(1, SHORT) == (0, UNABLE)  # nothing was learnt yet
    plant.expected(first := plant.action(state))
    state = plant.long_way(first)

    # One at a time, then several that wait already.
    actions, states = [], []
    for _ in range(2):
        actions.append(raw := plant.action(state))
        _, state = plant.expected(raw)
        states.append(plant.sent.encode(state))
        peer.say(raw)
        assert flow(1, LONG) == (1, MORE)
    for _ in range(3):
        actions.append(raw := plant.action(state))
        _, state = plant.expected(raw)
        states.append(plant.sent.encode(state))
    peer.say(*actions[-3:])
    began = time.monotonic()
    assert flow(50, SHORT) == (3, QUIET)
    assert 0.04 < time.monotonic() - began < 2.0
    assert peer.heard(5) == states
    assert plant.lockstep.step == plant.judge.step == 6

    # While it waits.
    raw = plant.action(state)
    _, state = plant.expected(raw)
    Timer(0.2, peer.say, [raw]).start()
    assert flow(50, LONG) == (1, QUIET)
    Timer(0.2, peer.say, [raw]).start()
    assert flow(50, LONG) == (0, OTHER)
    assert line.message() == raw
    assert peer.heard(1) == [plant.sent.encode(state)]

    # Nothing else is taken, and everything else is left to be handled.
    good = plant.action(state)
    for place, number in ((0, 1.0), (1, 2.0), (2, 6.0), (4, 78.0), (HEADER, np.nan), (-1, np.inf)):
        peer.say(bad := with_number(good, 8, place, number))
        assert flow(50, LONG) == (0, OTHER), (place, number)
        assert line.message() == bad
    for bad in (good[:-8], good + bytes(8), good.replace(b"env", b"enw", 1), good + bytes(100_000)):
        peer.say(bad)
        assert flow(50, LONG) == (0, OTHER)
        assert line.message()[: len(bad)] == bad
    assert plant.lockstep.step == 7
    peer.say(good, actions[-1])  # the next one, and an old one again
    assert flow(50, LONG) == (1, OTHER)
    assert line.message() == actions[-1]
    topic, state = plant.expected(good)
    assert peer.heard(1) == [plant.sent.encode(state)]

    # For those who record.
    peer.watch()
    while not loop.bundler.wanted:
        loop.bundler.look(loop.now())
    time.sleep(0.3)
    sent, told = [], []
    for _ in range(3):
        sent.append((ACTION_KIND, raw := plant.action(state), NO_TIME))
        _, state = plant.expected(raw)
        peer.say(raw)
        sent.append((STATE_KIND, plant.sent.encode(state), state.time if timed else NO_TIME))
        before = time.monotonic_ns()
        assert flow(1, LONG) == (1, MORE)
        told.append((before, time.monotonic_ns()))
    loop.bundler.flush()
    got = peer.samples()
    assert [(s.kind, s.raw, s.time) for s in got] == sent
    for i, (before, after) in enumerate(told):
        assert before <= got[2 * i].stamp <= got[2 * i + 1].stamp <= after
    assert len(peer.heard(3)) == 3

    # Up to the last state, never its answer.
    while plant.lockstep.step < plant.lockstep.horizon:
        raw = plant.action(state)
        _, state = plant.expected(raw)
        peer.say(raw)
        assert flow(50, SHORT)[0] == 1
    peer.say(last := plant.action(state))
    assert flow(50, LONG) == (0, UNABLE)
    for name in ("steps_total", "rounds_total", "time", "step", "tally"):
        assert getattr(plant.lockstep, name) == getattr(plant.judge, name), name
    (cost,) = plant.lockstep.action(plant.own.decode(last), 0.0)
    topic, expected = plant.expected(last)
    assert topic is COST and cost.topic is COST
    assert cost.frame.values.tobytes() == expected.values.tobytes()

    # What was taken is remembered: another answer to the same state voids the episode.
    state = plant.begin(2, (5, 6))
    state = plant.long_way(plant.action(state))
    peer.say(raw := plant.action(state))
    assert flow(1, LONG) == (0, OTHER)
    assert line.message() == last  # it is still on its way
    assert flow(1, LONG) == (1, MORE)
    assert plant.lockstep.action(plant.own.decode(raw), 0.0) == []
    other = with_number(raw, 8, -1, 0.123)
    (void,) = plant.lockstep.action(plant.own.decode(other), 0.0)
    assert (void.frame.values[:, CostColumn.ENDED] == VOID).all()
    line.close()
    node.destroy_node()
    peer.node.destroy_node()


def plant_with_instruments_does_not() -> None:
    node = rclpy.create_node("instruments")
    loop, plant = NodeLoop(node), Plant(measurement_noise=0.1)
    actions = loop.receive(ACTION, lambda frame: None)
    line = line_of(loop, actions, loop.sender(STATE), plant.reflex.ear)
    plant.long_way(plant.action(plant.begin(1, (3, 4))))
    assert plant.lockstep.flowing >= 0
    assert plant.reflex.flow(loop.bundler, 1, SHORT) == (0, UNABLE)
    line.close()
    node.destroy_node()


def controller_flows() -> None:
    node = rclpy.create_node("controller")
    loop, controller, peer = NodeLoop(node), Controller(3), Peer("state", "action")
    states = loop.receive(STATE, lambda frame: None)
    line = line_of(loop, states, loop.sender(ACTION), controller.reflex.ear)

    def flow(rounds: int, patience: int) -> tuple[int, int]:
        return controller.reflex.flow(rounds, time.monotonic_ns() + patience)

    peer.meet("action")
    controller.begin(4)
    assert flow(1, SHORT) == (0, UNABLE)
    controller.long_way(controller.state(4, 0))
    states = [controller.state(4, step) for step in range(1, 6)]
    peer.say(*states)
    assert flow(4, LONG) == (4, MORE)
    assert flow(4, SHORT) == (1, QUIET)
    assert peer.heard(5) == [controller.expected(raw) for raw in states]
    peer.say(states[2], other := controller.state(5, 0))  # asked again; and another episode
    assert flow(50, LONG) == (1, OTHER)
    assert line.message() == other
    assert peer.heard(1) == [controller.expected(states[2])]
    controller.reflex.settle()
    assert (controller.responder.answered, controller.responder.step) == (7, 3)
    controller.reflex.forget()
    assert flow(1, SHORT) == (0, UNABLE)
    line.close()
    node.destroy_node()
    peer.node.destroy_node()


def other_messages_end_a_wait() -> None:
    node = rclpy.create_node("interrupted")
    loop, controller, peer = NodeLoop(node), Controller(3), Peer("action", "state")
    states = loop.receive(STATE, lambda frame: None)
    line = line_of(loop, states, loop.sender(ACTION), controller.reflex.ear)
    other = loop.receive(ACTION, lambda frame: None)
    peer.meet("action")
    controller.begin(4)
    controller.long_way(controller.state(4, 0))

    def waits(seconds: float) -> bool:
        began = time.monotonic()
        until = time.monotonic_ns() + int(1e9 * seconds)
        assert controller.reflex.flow(1, until) == (0, QUIET)
        return time.monotonic() - began >= seconds

    doorbell = Doorbell([other.handle], loop._guard)
    assert doorbell.works
    assert waits(0.3)
    peer.say(raw := controller.state(4, 1))
    assert not waits(5.0)
    assert waits(0.3)  # once a message
    Timer(0.3, peer.say, [raw]).start()  # while it waits
    assert not waits(5.0)
    doorbell.close()
    peer.say(raw)
    assert waits(0.3)
    line.close()
    node.destroy_node()
    peer.node.destroy_node()


if __name__ == "__main__":
    rclpy.init()
    other_messages_end_a_wait()
    controller_flows()
    plant_flows()
    plant_flows(timed=True, opened=False)
    plant_with_instruments_does_not()
    workers.use_cores(range(2), attentive=True)
    plant_flows(helped=True, integration_time=0.0005)
    rclpy.shutdown()
    print("done")
