# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Introspection of a node: /diagnostics, trigger services, and other nodes of its name.

All of it runs in the node's housekeeping, off the hot path: nothing here is called for a message of
the loop.
"""

import math
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from std_srvs.srv import Trigger

from pdeloop.messages.diagnostics import ConditionTimer, Level, Status
from pdeloop.process.isolation import is_confined

NAMELESS = "_NODE_NAME_UNKNOWN_"
"""The graph's name for the node of an endpoint, before it has discovered the node."""
WAITING_REQUESTS = 100
"""Maximum number of requests to a service that wait for an answer."""
DIAGNOSTICS = "/diagnostics"
PERIOD = 1.0
"""Seconds between two reports, and between two inspections of the graph."""
WORKING = 1.0
"""Seconds of one computation after which it is reported while it lasts."""
NAMESAKE_GRACE = 6.0
"""Seconds a second node of a name may be seen before it counts: a killed one is seen for 4 s."""
NAMESAKE_GRACE_OUTSIDE = 25.0
"""The same where the profile is not ours, and the middleware's lease is perhaps its default of 20 s."""
AGAIN = 10.0
"""Seconds after which a warning that still holds is repeated."""


def full_name(endpoint: Any) -> str:
    """The full name of the node that an endpoint in the ROS graph belongs to."""
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"


def process_of(endpoint: Any) -> bytes:
    """The process of an endpoint in the ROS graph: the common prefix of the ids of its endpoints."""
    return bytes(endpoint.endpoint_gid)[:12]


def matched_processes(node: Node, publisher: Publisher) -> set[bytes]:
    """The processes whose subscriptions receive the publisher's messages from now on.

    The graph shows the subscribers, the publisher how many of them it is matched with: none is named
    before all are.
    """
    there = node.get_subscriptions_info_by_topic(publisher.topic_name)
    if publisher.get_subscription_count() < len(there):
        return set()
    return {process_of(endpoint) for endpoint in there}


def incompatible(offered: QoSProfile, asked: QoSProfile) -> str:
    """Why messages of a publisher cannot arrive at a subscriber; empty if they can."""
    verdict, reason = qos_check_compatible(offered, asked)
    return reason.removeprefix("ERROR: ").rstrip(";") if verdict == QoSCompatibility.ERROR else ""


class Introspection:
    """Publishes a node's diagnostics, and warns of other nodes that should not be there."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._topics: dict[str, QoSProfile] = {}
        self._refused, self._reported, self._reason = 0, 0, ""
        self._publisher: Publisher | None = None
        self._diagnostics: Callable[[float], Status] = lambda now: Status(Level.OK, "")
        self._status = DiagnosticStatus(hardware_id=socket.gethostname())
        self._due = 0.0
        self._working_due = 0.0
        self._began = time.monotonic()
        self._namesake = ConditionTimer()
        self._last = Status(Level.OK, "")
        self._working: tuple[str, float] | None = None
        self._publishing = threading.Lock()
        self.several_publishers: dict[str, list[str]] = {}
        """The nodes that published a topic which one node should publish."""
        self.unreachable: dict[str, str] = {}
        """Of a topic: which publisher's messages cannot arrive, and why."""
        self._known: dict[str, int] = {}
        """Publishers of a topic that were looked at."""
        self._doubled: dict[str, ConditionTimer] = {}
        """Timers of topics with two publishers of one name."""
        self._grace = NAMESAKE_GRACE if is_confined() else NAMESAKE_GRACE_OUTSIDE
        self._told: dict[str, float] = {}
        """Times of the last warnings."""

    def supervise(self, name: str, qos: QoSProfile) -> None:
        """Check the publishers of a topic, by its full name: one other node should publish it.

        qos: what this node's subscriber asks for.
        """
        self._topics[name] = qos

    def refuse(self, topic: str, reason: object, count: int = 1) -> None:
        """Count messages that were refused; they are reported with the next `round` that works."""
        self._refused += count
        self._reason = f"{topic}: {reason}"[:300]

    def report(self, task: str, status: Callable[[float], Status]) -> None:
        """Publish what `status(now)` says once a second, under the node's name and `task`."""
        self._publisher = self._node.create_publisher(DiagnosticArray, DIAGNOSTICS, 1)
        name = self._node.get_fully_qualified_name().removeprefix("/")
        self._status.name = f"{name}: {task}"
        self._diagnostics = status

    def round(self, now: float) -> None:
        """Do the work of one round, once a second. Call it at every housekeeping."""
        if now < self._due:
            return
        # A steady period, though the housekeeping comes a little late each time.
        self._due = max(self._due + PERIOD, now + PERIOD / 2)
        self.look_at_publishers(now)
        namesakes, refused = self._namesakes(now), self.log_refused()
        if self._publisher is None:
            return
        status = self._diagnostics(now)
        if refused:
            status = status.merged(Level.WARN, f"refused {refused} message(s): {self._reason}")
        if namesakes:
            status = status.merged(Level.WARN, "another node has this name")
        uptime = round(now - self._began, 1)
        values = {**status.values, "refused messages": self._refused, "uptime": uptime}
        self._last = Status(status.level, status.message, values)
        self._publish(self._publisher, self._last)

    def log_refused(self) -> int:
        """Log how many messages were refused since the last call, and return that number."""
        refused = self._refused - self._reported
        self._reported = self._refused
        if refused:
            self._node.get_logger().warning(
                f"refused {refused} message(s), the last one because: {self._reason}"
            )
        return refused

    def offer(self, name: str, act: Callable[[], str]) -> None:
        """A std_srvs/Trigger service, after which the node reports at once.

        act: acts and returns what was done; ValueError if it is not possible.
        """

        def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.success, response.message = True, act()
            except ValueError as error:
                response.success, response.message = False, str(error)
            self._due = 0.0
            self._node.get_logger().info(f"{name}: {response.message}")
            return response

        waiting = QoSProfile(depth=WAITING_REQUESTS)
        self._node.create_service(Trigger, name, answer, qos_profile=waiting)

    @contextmanager
    def working(self, what: str) -> Iterator[None]:
        """The node's thread computes `what` for the time of the block, and may not come to `round`."""
        self._working = what, time.monotonic()
        try:
            yield
        finally:
            self._working = None

    def round_while_working(self, now: float) -> None:
        """`round` from another thread, while a computation keeps the node's own from it.

        Publishes the last report with the values `activity` and `activity for` (s) added.
        """
        working, publisher = self._working, self._publisher
        if working is None or publisher is None or now < self._working_due:
            return
        what, since = working
        if now - since < WORKING:
            return
        self._working_due = now + PERIOD
        seconds = now - since
        values = {**self._last.values, "activity": what, "activity for": round(seconds, 1)}
        self._publish(publisher, Status(self._last.level, f"{what} for {seconds:.0f} s", values))

    def _publish(self, publisher: Publisher, status: Status) -> None:
        with self._publishing:
            own = self._status
            own.level, own.message = bytes([status.level]), status.message
            own.values = [KeyValue(key=key, value=value) for key, value in status.texts()]
            message = DiagnosticArray(status=[own])
            message.header.stamp = self._node.get_clock().now().to_msg()
            publisher.publish(message)

    def look_at_publishers(self, now: float) -> bool:
        """Warn of several publishers of one topic, and of one whose QoS is not compatible.

        Returns whether every publisher's name is known; it is discovered a little after the
        publisher.
        """
        all_named = True
        for topic, asked in self._topics.items():
            count = self._node.count_publishers(topic)
            if count < 2 and count == self._known.get(topic):
                continue
            there = [
                (full_name(endpoint), endpoint.qos_profile)
                for endpoint in self._node.get_publishers_info_by_topic(topic)
                if endpoint.node_name != NAMELESS  # one that was just started again may be
            ]
            self._known[topic] = len(there)
            all_named &= len(there) == count
            for name, offered in there:
                if reason := incompatible(offered, asked):
                    text = (
                        f"{name} publishes {topic}, but its messages cannot arrive (QoS: {reason})"
                    )
                    self.unreachable[topic] = text
                    if self._is_due(text, now):
                        self._node.get_logger().error(
                            f"{text}; expected a publisher as in docs/protocol.md"
                        )
            found = self._several(topic, Counter(name for name, _ in there), now)
            if found:
                known = self.several_publishers.get(topic, ())
                self.several_publishers[topic] = sorted({*found, *known})
                text = f"several nodes publish {topic}: {', '.join(found)}"
                if self._is_due(text, now):
                    self._node.get_logger().warning(
                        f"{text}; only messages of this run, episode, step and plant count"
                    )
        return all_named

    @property
    def undecided(self) -> bool:
        """True while a topic has two publishers of one name, of which one may have just ended."""
        known = self.several_publishers
        return any(timer.holds for topic, timer in self._doubled.items() if topic not in known)

    def _several(self, topic: str, names: Counter[str], now: float) -> list[str]:
        """The publishers of a topic by the names of their nodes, if they are several nodes."""
        doubled = self._doubled.setdefault(topic, ConditionTimer())
        lasts = doubled.seconds(names.total() > len(names), now) > self._grace
        if len(names) < 2 and not lasts:
            return []
        return [
            f"{name} ({count} nodes of this name)" if count > 1 and lasts else name
            for name, count in sorted(names.items())
        ]

    def _is_due(self, text: str, now: float) -> bool:
        """True unless the same warning has just been given."""
        due = now >= self._told.get(text, -math.inf) + AGAIN
        if due:
            self._told = {known: at for known, at in self._told.items() if now < at + AGAIN}
            self._told[text] = now
        return due

    def _namesakes(self, now: float) -> int:
        """Count, and report, other nodes that have had this one's full name for a while.

        A node is there as long as its services are: the graph's list of names can keep a node that has
        left, for good, when what it said last is read only after it has gone.
        """
        own = f"{self._node.get_fully_qualified_name()}/get_parameters"
        others = self._node.count_services(own) - 1
        if self._namesake.seconds(others > 0, now) <= self._grace:
            return 0
        self._node.get_logger().warning(
            f"{others} other node(s) called {self._node.get_fully_qualified_name()} in this ROS "
            "domain: services and parameters reach any of them; stop one, or give it another name "
            "(-r __node:=NAME) or namespace (-r __ns:=/NAME)",
            throttle_duration_sec=10.0,
        )
        return others
