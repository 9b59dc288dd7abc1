# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A recorder that ends, waits or has no room: what it has is whole, and the loop goes on as chosen."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from pdeloop.bags.info import describe
from pdeloop.bags.reader import Bag
from pdeloop.bags.verify import verify
from recorder_node.node import DRAIN, FLUSH
from tests.support.loop_harness import Processes, until
from tests.support.small import paced
from tests.support.small_disk import read_only_folder, small_disk
from tests.support.small_loop import (
    LIMIT,
    adapted,
    assert_same_training,
    in_process,
    start_pair,
    start_tuner,
)

pytestmark = pytest.mark.topics


class Hand:
    """Nodes started by hand, with a recorder beside them."""

    def __init__(
        self,
        loop: Processes,
        bag: Path,
        out: Path,
        recorder: str,
        iterations: int,
        pace: float = 0.0,
        **more: object,
    ) -> None:
        self.bag, self.out = bag, out
        self.recorder = loop.node(
            "recorder_node",
            *(word for n, v in {"bag": bag, **more}.items() for word in ("-p", f"{n}:={v}")),
        )
        start_pair(loop, real_time_factor=pace)
        self.tuner = start_tuner(loop, out, iterations=iterations, recorder=recorder)


def test_a_killed_recorder_loses_a_second_at_most_and_the_training_goes_on(loop, tmp_path):
    hand = Hand(loop, tmp_path / "bag", tmp_path / "run", "start", 60, pace=100.0)
    until(lambda: adapted(hand.out) >= 15, LIMIT, "iteration 15")
    # Without the tuner too little is sent to be written for its size: it is for its age.
    assert FLUSH + DRAIN < 1.0
    hand.tuner.send_signal(signal.SIGSTOP)
    stopped = time.time()
    for _ in range(2):  # what came until then is written, and then what the recorder still had
        now = time.time()
        until(lambda now=now: describe(hand.bag)["last"] / 1e9 > now, LIMIT, "a recent message")
    hand.recorder.send_signal(signal.SIGKILL)
    hand.tuner.send_signal(signal.SIGCONT)
    loop.wait(hand.tuner, LIMIT)
    assert_same_training(hand.out, in_process(iterations=60))
    assert not describe(hand.bag)["finished"]
    before = [e for e in Bag(hand.bag).episodes() if e.last / 1e9 < stopped]
    assert len(before) > 10 and not any(e.missing for e in before)
    report = verify(hand.bag)
    assert report.count == 0 and report.compared["policies"] > 20


def test_a_recorder_that_is_held_up_for_a_second_misses_nothing(loop, tmp_path):
    # 2000 steps of 0.8 kB a second, less than the 4 MB of the recorder's socket. On a fast machine this
    # loop sends several times as much, if it may.
    hand = Hand(loop, tmp_path / "bag", tmp_path / "run", "start", 100, pace=100.0)
    until(lambda: adapted(hand.out) >= 5, LIMIT, "iteration 5")
    hand.recorder.send_signal(signal.SIGSTOP)
    before = adapted(hand.out)
    time.sleep(1.0)
    until(lambda: adapted(hand.out) > before + 5, LIMIT, "a loop that does not wait")
    hand.recorder.send_signal(signal.SIGCONT)
    loop.wait(hand.tuner, LIMIT)
    hand.recorder.send_signal(signal.SIGINT)
    loop.wait(hand.recorder, LIMIT)
    report = verify(hand.bag)
    assert (report.count, report.incomplete, report.episodes) == (0, [], 103)


INTAKE = """
import rclpy, time
from std_msgs.msg import String
from pdeloop.ros.endpoints import raw_subscription
from pdeloop.ros.sample_subscription import SerializedSubscription
rclpy.init()
node = rclpy.create_node("intake")
intake = SerializedSubscription(raw_subscription(node, String, "words", 50), String, 50)
publisher = node.create_publisher(String, "words", 50)
while not publisher.get_subscription_count():
    time.sleep(0.01)

def tell(*words):
    for word in words:
        publisher.publish(String(data=word))
    assert publisher.wait_for_all_acked()  # they have come

def taken(until=None):
    return [bytes(raw)[8:].rstrip(b"\\0").decode() for raw, _ in intake.take(until)]

tell("a", "b")
moment = time.time_ns()
tell("c", "d")
print("until the moment", taken(moment))
print("again", taken(moment))
print("before", taken(moment - 1))  # as if the clock had been set back: no message waits for ever
tell("e")
print("rest", taken())
"""


def test_what_came_after_a_moment_is_left_for_the_next_time(loop):
    lines = loop.wait(loop.start("-c", INTAKE, name="intake"), LIMIT).splitlines()
    assert lines == ["until the moment ['a', 'b']", "again []", "before ['c']", "rest ['d', 'e']"]


def test_a_training_that_must_be_recorded_stops_when_the_recorder_does(loop, tmp_path):
    hand = Hand(loop, tmp_path / "bag", tmp_path / "run", "required", 100_000, pace=20.0)
    until(lambda: adapted(hand.out) >= 20, LIMIT, "iteration 20")
    hand.recorder.send_signal(signal.SIGTERM)
    loop.wait(hand.recorder, LIMIT)
    text = loop.wait(hand.tuner, LIMIT, code=1)
    assert "tuner_node: the recorder has gone, but this training has to be recorded" in text
    assert verify(hand.bag).count == 0


@pytest.mark.parametrize(
    ("recorder", "iterations", "pace"), [("start", 150, 300.0), ("required", 100_000, 100.0)]
)
def test_a_full_disk_ends_the_recording_and_the_training_as_the_user_chose(
    loop, tmp_path, recorder, iterations, pace
):
    with small_disk(tmp_path / "disk", megabytes=1) as disk:
        # At this pace the disk takes several chunks: what is cut short is the last of them alone.
        hand = Hand(loop, disk / "bag", tmp_path / "run", recorder, iterations, pace=pace)
        text = loop.wait(hand.recorder, LIMIT, code=3)
        last = text.strip().splitlines()[-1]
        assert last.startswith(f"recorder_node: cannot write to {disk / 'bag'}: ")
        assert "No space left on device" in last
        assert "recording has stopped" in last
        loop.wait(hand.tuner, LIMIT, code=0 if recorder == "start" else 1)
        if recorder == "start":
            assert_same_training(hand.out, in_process(iterations=iterations))
        report = verify(hand.bag)
        assert report.count == 0 and report.compared["policies"] > 20


def test_a_bag_that_cannot_be_begun_is_refused_in_one_line(loop, tmp_path):
    (tmp_path / "there").mkdir()
    text = loop.wait(loop.node("recorder_node", "-p", f"bag:={tmp_path / 'there'}"), LIMIT, code=1)
    assert text.strip().splitlines() == [
        f"recorder_node: {tmp_path / 'there'} already exists; choose another folder for the bag"
    ]
    with read_only_folder(tmp_path / "locked") as folder:
        text = loop.wait(loop.node("recorder_node", "-p", f"bag:={folder / 'b'}"), LIMIT, code=1)
    (line,) = text.strip().splitlines()
    assert line.startswith(f"recorder_node: cannot write a bag to {folder / 'b'}: ")


LATE_SUBSCRIPTION = """
import time
import rclpy
from std_msgs.msg import Float64MultiArray, String
from pdeloop.messages.topics import episode_name
from pdeloop.ros.endpoints import raw_subscription, reader_qos, writer_qos
from pdeloop.messages.topics import MODEL, RECORDER_STATUS, START

rclpy.init()
node = rclpy.create_node("late")
publisher = node.create_publisher(String, RECORDER_STATUS, writer_qos(MODEL))
time.sleep(2)  # in which a tuner that needs no more than this has long begun
subscription = raw_subscription(node, Float64MultiArray, START.name, reader_qos(START))
while (taken := subscription.handle.take_message(Float64MultiArray, True)) is None:
    time.sleep(0.001)
print("first", episode_name(START.codec().decode(taken[0]).episode))
while node.count_publishers(START.name):
    time.sleep(0.05)
"""


def test_no_episode_begins_before_its_start_reaches_the_recorder(loop, tmp_path):
    start_pair(loop)
    tuner = start_tuner(loop, tmp_path / "run", iterations=20, recorder="start")
    late = loop.start("-c", LATE_SUBSCRIPTION, name="late")
    loop.wait(tuner, LIMIT)
    assert loop.wait(late, LIMIT).splitlines() == ["first 1.1"]


def test_a_killed_recorder_is_started_again_and_goes_on_in_another_bag(loop, tmp_path):
    out = tmp_path / "run"
    words = ("train", str(paced(tmp_path, 10.0)), "--iterations", "40", "--out", str(out))
    run = loop.pdeloop(*words, "--record")
    until(lambda: adapted(out) >= 3, LIMIT, "iteration 3")
    (pid,) = loop.pids("recorder_node")
    os.kill(pid, signal.SIGKILL)
    text = loop.wait(run, LIMIT)
    assert text.count("recorder_node was killed by SIGKILL; starting it again") == 1
    assert f"recorded in {out / 'bag'}, {out / 'bag-2'}\n" in text
    assert_same_training(out, in_process(iterations=40))
    report = verify(out)
    assert report.count == 0, report.text()
    (missing,) = report.missing  # while no recorder was there
    assert "rollouts that the training asked for" in missing
    assert describe(out / "bag-2")["finished"]


MATCHING = """
import sys, time
import rclpy, rclpy.executors
from std_msgs.msg import String
from pdeloop.ros import parameters
from pdeloop.ros.peers import Peers
from recorder_node.matching import PATIENCE, Matching

rclpy.init()
parameters.UNANSWERED = 0.0  # every answer comes later than that
served = sys.argv[1] == "served"
plant = rclpy.create_node("plant", start_parameter_services=served)
publisher = plant.create_publisher(String, "state", 1)
recorder = rclpy.create_node("recorder")
peers = Peers(recorder)
matching = Matching(peers, required=["/state"], others=[])


def look_until(condition):
    while not condition():
        matching.look(time.monotonic())
        time.sleep(0.01)
    return peers.known[0]


peer = look_until(lambda: peers.known and peers.known[0].name)
if served:  # its services are there, but busy
    look_until(lambda: peer.offers_parameters)
for waited in (PATIENCE - 1, PATIENCE + 1):
    print("after", waited, matching.complete(peer.since + waited))
if served:
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(plant)
    executor.add_node(recorder)

    def answered():
        executor.spin_once(0)
        return peer.values is not None

    look_until(answered)
    print("answered", matching.complete(peer.since))
"""


def test_a_slow_answer_is_waited_for_and_a_node_without_services_is_not(loop):
    slow = loop.start("-c", MATCHING, "served", name="slow")
    lines = loop.wait(
        slow, LIMIT
    ).splitlines()  # among them rclpy's warnings, of a response that waits
    lines = [line for line in lines if line.startswith(("after", "answered"))]
    assert lines == ["after 9.0 False", "after 11.0 False", "answered True"]
    mute = loop.start("-c", MATCHING, "not", name="mute")
    assert loop.wait(mute, LIMIT).splitlines() == ["after 9.0 False", "after 11.0 True"]
