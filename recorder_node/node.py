"""recorder_node: writes the loop's topics to a rosbag2 bag, as a ROS 2 node.

Subscribes  every topic of the loop in its namespace (and of `pairs`), /clock
Publishes   recorder/status (std_msgs/String, latched; from when nothing can be missed any more)
It takes serialised bytes in batches, off the loop's path. What is written: recorder_node.recording.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray, String

from loop_interfaces.frames import FrameError
from loop_interfaces.isolation import keep_on_this_machine
from loop_interfaces.parameters import taken_by
from loop_interfaces.ros.endpoints import raw_subscription, reader_qos, scoped
from loop_interfaces.ros.node_loop import NodeLoop
from loop_interfaces.ros.node_main import ConfigurationError, node_main
from loop_interfaces.ros.parameters import declare, given_parameters
from loop_interfaces.ros.sample_subscription import SampleSubscription, SerializedSubscription
from loop_interfaces.samples import ACTION_KIND, CLOCK_KIND, STATE_KIND
from loop_interfaces.topics import ACTION, RECORDER_STATUS, START, STATE
from recorder_node.bag import BagError
from recorder_node.diagnostics import RecorderHealth
from recorder_node.peers import Peers
from recorder_node.recording import (
    ARRAY_TYPE,
    CLOCK_TYPE,
    TEXT_TYPE,
    Recording,
    Source,
    clock,
    sources,
)

RECORDING_FAILED = 3
"""Exit code when writing fails later on; 1 is a recording that cannot begin."""
DRAIN = 0.02
"""Seconds between two batches: often enough for the depth below, seldom enough to cost little."""
FLUSH = 0.3
"""Seconds of recording that a SIGKILL may lose at the most."""
HELD_UP, CATCH_UP = 0.15, 0.5
"""Seconds between two rounds after which this process was held up, and in which it then takes what has
come in meanwhile, before it says of an episode that something is missing."""
DEPTH = 1000
"""Messages of a latched topic that wait here: of seconds of the fastest loop, should this process
be held up."""
REPORT = 1.0
"""Seconds between two messages on recorder/status."""
SLICE, PAST = 200_000_000, 10_000_000_000
"""Nanoseconds of arrivals that are recorded in one batch, so that a recorder that is behind writes what
it has, too; and by how much it can be behind, beyond which the clock was set."""
QUIET = 0.1
"""At the end: seconds without a message after which nothing more is on its way."""
_TYPES = {ARRAY_TYPE: Float64MultiArray, TEXT_TYPE: String}
_KINDS = {STATE: STATE_KIND, ACTION: ACTION_KIND}

STATUS_QOS = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
)
"""Latched: a tuner that starts later learns of the recorder, too."""


def _declare(node: Node) -> dict[str, Any]:
    return declare(node, taken_by("recorder_node"), given_parameters(node))


class RecorderNode:
    """Moves serialised messages from the topics into the recording."""

    def __init__(self, node: Node, loop: NodeLoop) -> None:
        values = _declare(node)
        names: list[str] = values["pairs"]
        self._namespaces = [
            node.resolve_topic_name(scoped(name, "state")).removesuffix("state") for name in names
        ]
        what = [source for namespace in self._namespaces for source in sources(namespace)]
        what += [clock()] if values["record_clock"] else []
        folder = str(values["bag"]) or time.strftime("bags/%Y%m%d-%H%M%S")
        self._recording = Recording(
            Path(folder),
            what,
            storage=values["bag_storage"],
            bag_per_episode=values["bag_per_episode"],
        )
        self._what = what
        self._health = RecorderHealth(self._recording)
        self._flush_at = self._report_at = self._caught_up_at = 0.0
        self._ticked = math.inf
        self._until, self._behind = 0, False
        self._wire(node, loop)
        self._log.info(f"recording to {self._recording.path} ({values['bag_storage']})")

    def join(self, node: Node, loop: NodeLoop) -> None:
        """Go on with the same bag on a new node; what was missed shows as incomplete episodes."""
        _declare(node)
        self._wire(node, loop)

    def _wire(self, node: Node, loop: NodeLoop) -> None:
        self._node, self._loop, self._log = node, loop, node.get_logger()
        # States, actions and /clock come from watchers, the rest from subscriptions of their own.
        self._watchers: list[tuple[SampleSubscription, dict[int, Source]]] = []
        clocks = [source for source in self._what if source.channel.type == CLOCK_TYPE]
        times, told = {CLOCK_KIND: clocks[0]} if clocks else {}, bool(clocks)
        for absolute in self._namespaces:
            namespace = absolute.rstrip("/") or "/"
            mine = [s for s in self._what if s.namespace == namespace]
            kinds = {_KINDS[s.array]: s for s in mine if s.array in _KINDS} | times
            first = not self._watchers
            watcher = SampleSubscription(node, namespace, clock=told, single_clock=first and told)
            self._watchers.append((watcher, kinds))
        self._intakes = [(s, self._subscribe(s)) for s in self._what if s.channel.latched]
        self._peers = Peers(
            node,
            required=[f"{n}{topic.name}" for n in self._namespaces for topic in (STATE, ACTION)],
            others=[f"{n}{START.name}" for n in self._namespaces],
        )
        self._status: Publisher | None = None
        loop.diagnose(
            "recording", lambda now: self._health.report(now, matched=self._status is not None)
        )

    def run(self) -> int:
        """Record until a signal comes; 0, or RECORDING_FAILED when the disk refuses."""
        recording = self._recording
        try:
            self._loop.run(tick=self._tick, deadline=lambda: 0.0, housekeeping=self._housekeeping)
            if self._loop.suspended:
                return 0
            deadline = time.monotonic() + 1.0
            quiet_at = time.monotonic() + QUIET
            while time.monotonic() < min(quiet_at, deadline):
                time.sleep(DRAIN)
                if self._drain(PAST):
                    quiet_at = time.monotonic() + QUIET
            recording.close()
        except BagError as error:
            print(f"recorder_node: {error}", file=sys.stderr)
            return RECORDING_FAILED
        self._log.info(
            f"{recording.messages} messages of {recording.episodes} episodes in {recording.path}, "
            f"{recording.incomplete} of them incomplete"
        )
        return 0

    def _subscribe(self, source: Source) -> SerializedSubscription:
        kind, qos = _TYPES[source.channel.type], reader_qos(START, DEPTH)
        return SerializedSubscription(
            raw_subscription(self._node, kind, source.channel.topic, qos), kind, DEPTH
        )

    def _tick(self, _: float) -> None:
        if not self._behind:
            time.sleep(DRAIN)
        self._drain(SLICE)
        now = self._loop.now()
        if self._behind or now - self._ticked > HELD_UP:
            self._caught_up_at = now + CATCH_UP
        self._ticked = now
        if now >= self._flush_at:
            self._flush_at = now + FLUSH
            self._recording.flush()
            if now >= self._caught_up_at:
                self._recording.index(time.time_ns())

    def _drain(self, longest: int) -> int:
        """Record what has come in since the last time, in the order of arrival, of `longest` ns.

        Of all topics up to the same moment: what is written next to each other then belongs
        together, even if this process is held up between two of them and killed after it.
        """
        now = time.time_ns()
        self._behind = longest < now - self._until < PAST
        self._until = until = self._until + longest if self._behind else now
        taken: list[tuple[int, int, Source, bytes]] = []
        for watcher, by_kind in self._watchers:
            try:
                for kind, when, raw in watcher.drain(until):
                    if kind in by_kind:
                        taken.append((when, len(taken), by_kind[kind], raw))
            except FrameError as error:
                self._log.warning(f"samples: {error}", throttle_duration_sec=1.0)
        for source, intake in self._intakes:
            for raw, info in intake.take(until):
                taken.append((info["received_timestamp"], len(taken), source, raw))
        taken.sort()  # no two have the same number
        for when, _, source, raw in taken:
            self._recording.take(source, when, raw)
        self._recording.pause()
        return len(taken)

    def _housekeeping(self, now: float) -> None:
        for watcher, _ in self._watchers:
            watcher.look()
        self._peers.look(now)
        run = self._recording.run
        if run and self._peers.changed(run):
            self._recording.note(run, self._peers.parameters())
        if self._status is None and self._peers.all_matched(now):
            self._status = self._node.create_publisher(String, RECORDER_STATUS, STATUS_QOS)
            self._log.info("matched with all publishers of the loop")
        if self._status is not None and now >= self._report_at:
            self._report_at = now + REPORT
            self._status.publish(String(data=self._status_text()))

    def _status_text(self) -> str:
        recording = self._recording
        return json.dumps(
            {
                "bag": str(recording.path.resolve()),
                "messages": recording.messages,
                "episodes": recording.episodes,
                "incomplete": recording.incomplete,
            }
        )


def _make(node: Node, loop: NodeLoop) -> RecorderNode:
    try:
        return RecorderNode(node, loop)
    except BagError as error:
        raise ConfigurationError(str(error)) from error


def _stand_back() -> None:
    """Let the loop's processes go first: a message that arrives here must not preempt its sender."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def main(args: list[str] | None = None) -> int:
    """Console script."""
    _stand_back()
    keep_on_this_machine()
    return node_main("recorder_node", args, _make)


if __name__ == "__main__":
    sys.exit(main())
