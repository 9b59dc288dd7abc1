# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""recorder_node: writes the loop's topics to a rosbag2 bag, as a ROS 2 node.

Subscribes  every topic of the loop in its namespace (and of `pairs`), /clock, /diagnostics, /rosout
Publishes   recorder/status (std_msgs/String, latched; from when nothing can be missed any more)
A timer takes the serialised messages that have come in, in the order of their arrival over all
topics. What is written: recorder_node.recording.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from pdeloop.messages.diagnostics import Level, Rate, Status
from pdeloop.messages.frames import FrameError
from pdeloop.messages.parameters import taken_by
from pdeloop.messages.samples import ACTION_KIND, CLOCK_KIND, STATE_KIND
from pdeloop.messages.topics import ACTION, RECORDER_STATUS, START, STATE
from pdeloop.process.affinity import lower_priority
from pdeloop.process.isolation import keep_on_this_machine
from pdeloop.ros.endpoints import message_class, raw_subscription, scoped
from pdeloop.ros.node_main import ConfigurationError, node_main
from pdeloop.ros.observer import Observer
from pdeloop.ros.parameters import declare, given_parameters
from pdeloop.ros.peers import Peers
from pdeloop.ros.sample_subscription import SampleSubscription, SerializedSubscription
from recorder_node.bag import BagError
from recorder_node.matching import Matching
from recorder_node.recording import (
    CLOCK,
    DIAGNOSTICS,
    ROSOUT,
    Recording,
    Source,
    large_bag,
    sources,
)

RECORDING_FAILED = 3
"""Exit code when writing fails later on; 1 is a recording that cannot begin."""
DRAIN = 0.02
"""Seconds between two batches: often enough for the depth below, seldom enough to cost little."""
FLUSH = 0.3
"""Maximum seconds of recording that a SIGKILL may lose."""
LOOK = 0.1
"""Seconds between two rounds of reading the ROS graph."""
DEPTH = 1000
"""Messages of a topic that may wait: seconds of the fastest loop, if this process is held up."""
LATCHED = DurabilityPolicy.TRANSIENT_LOCAL
"""A node that starts later also gets the earlier messages."""
QUIET, END = 0.1, 1.0
"""At the end: seconds without a message after which the recording ends, and the maximum wait."""


class RecorderNode:
    """Moves serialised messages from the topics into the recording."""

    def __init__(self, node: Node, loop: Observer) -> None:
        values = declare(node, taken_by("recorder_node"), given_parameters(node, "recorder_node"))
        self._namespaces = [
            node.resolve_topic_name(scoped(name, "state")).removesuffix("state")
            for name in values["pairs"]
        ]
        self._sources = [source for name in self._namespaces for source in sources(name)]
        self._sources += [DIAGNOSTICS, ROSOUT, CLOCK]
        folder = str(values["bag"]) or time.strftime("bags/%Y%m%d-%H%M%S")
        self._every = int(values["state_every"])
        self._recording = Recording(Path(folder), self._sources, self._every)
        self._rate = Rate()
        self.join(node, loop)
        self._log.info(f"recording to {self._recording.path}")

    def join(self, node: Node, loop: Observer) -> None:
        """Wire the topics; after a suspension, what was missed shows as incomplete episodes."""
        self._node, self._loop, self._log = node, loop, node.get_logger()
        self._others: list[tuple[Source, SerializedSubscription]] = []
        self._samples: list[tuple[SampleSubscription, dict[int, Source]]] = []
        # The starts last: they are discovered last, and a tuner waits until its own reach us.
        for source in sorted(self._sources, key=lambda source: source.array is START):
            if source.array not in (STATE, ACTION) and source is not CLOCK:
                self._subscribe(source)
        self._subscribe_samples()
        self._matching = Matching(
            Peers(node),
            required=[f"{n}{topic.name}" for n in self._namespaces for topic in (STATE, ACTION)],
            others=[f"{n}{START.name}" for n in self._namespaces],
        )
        self._status: Publisher | None = None
        loop.introspection.report("recording", self._report)
        loop.every(DRAIN, self._record)
        loop.every(FLUSH, self._recording.flush)
        loop.every(LOOK, self._look)

    def _subscribe(self, source: Source) -> None:
        kind, channel = message_class(source.channel.type), source.channel
        qos = LATCHED if channel.latched else DurabilityPolicy.VOLATILE
        subscription = raw_subscription(
            self._node, kind, channel.topic, QoSProfile(depth=DEPTH, durability=qos)
        )
        self._others.append((source, SerializedSubscription(subscription, kind, DEPTH)))

    def _subscribe_samples(self) -> None:
        """States and actions, and the time on /clock that goes with them, once for all pairs."""
        for number, absolute in enumerate(self._namespaces):
            namespace = absolute.rstrip("/") or "/"
            arrays = {s.array: s for s in self._sources if s.namespace == namespace}
            kinds = {STATE_KIND: arrays[STATE], ACTION_KIND: arrays[ACTION], CLOCK_KIND: CLOCK}
            samples = SampleSubscription(
                self._node, namespace, clock=True, single_clock=number == 0
            )
            self._samples.append((samples, kinds))

    def run(self) -> int:
        """Record until a signal comes; 0, or RECORDING_FAILED when the disk refuses."""
        recording = self._recording
        try:
            self._loop.run()
            if self._loop.suspended:
                return 0
            end, known = time.monotonic() + END, -1
            while recording.messages > known and time.monotonic() < end:
                known = recording.messages
                time.sleep(QUIET)
                self._record()
            recording.close()
        except BagError as error:
            print(f"recorder_node: {error}", file=sys.stderr)
            return RECORDING_FAILED
        self._log.info(f"{recording.messages} messages in {recording.path}")
        return 0

    def _record(self) -> None:
        """Record what has arrived since the last time, in the order of arrival.

        It takes all topics up to the same moment, so that what stands together in the bag belongs
        together, even if this process is held up between two topics and then killed.
        """
        until = time.time_ns()
        taken: list[tuple[int, int, Source, bytes]] = []
        for samples, by_kind in self._samples:
            try:
                for kind, when, raw in samples.drain(until):
                    taken.append((when, len(taken), by_kind[kind], raw))
            except FrameError as error:
                self._log.warning(f"samples: {error}", throttle_duration_sec=1.0)
        for source, subscription in self._others:
            for raw, info in subscription.take(until):
                taken.append((info["received_timestamp"], len(taken), source, raw))
        taken.sort()  # no two have the same number
        for when, _, source, raw in taken:
            self._recording.take(source, when, raw)
        self._recording.pause()

    def _report(self, now: float) -> Status:
        recording, matched = self._recording, self._status is not None
        return Status(
            Level.OK if matched else Level.WARN,
            "recording" if matched else "not yet matched with all publishers of the loop",
            {
                "run": recording.run or None,
                "bag": str(recording.path.resolve()),
                "matched": matched,
                "messages": recording.messages,
                "messages/s": self._rate.per_second(recording.messages, now),
            },
        )

    def _look(self) -> None:
        """Read the ROS graph, and say when nothing can be missed any more."""
        now = time.monotonic()
        for samples, _ in self._samples:
            samples.poll()
        self._matching.look(now)
        run = self._recording.run
        if run and self._matching.changed(run):
            parameters = self._matching.parameters()
            self._recording.note(run, parameters)
            if text := large_bag(parameters, self._every):
                self._log.warning(text)
        if self._status is None and self._matching.complete(now):
            self._status = self._node.create_publisher(
                String, RECORDER_STATUS, QoSProfile(depth=1, durability=LATCHED)
            )
            self._status.publish(String(data=str(self._recording.path.resolve())))
            self._log.info("matched with all publishers of the loop")


def _make(node: Node, loop: Observer) -> RecorderNode:
    try:
        return RecorderNode(node, loop)
    except BagError as error:
        raise ConfigurationError(str(error)) from error


def main(args: list[str] | None = None) -> int:
    """Console script."""
    lower_priority()
    keep_on_this_machine()
    return node_main("recorder_node", args, _make, Observer)


if __name__ == "__main__":
    sys.exit(main())
