# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The base of the nodes' event loops, and the loop of a node that only observes.

The nodes that answer states have one of their own (pdeloop.ros.node_loop). An observer's
serves whatever the node has on rclpy's executor, ordinary timers and subscriptions. Both publish
/diagnostics, and end by a signal, on request, or when the process was suspended for so long that
its peers have forgotten it.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.node import Node
from rclpy.service import Service

from pdeloop.ros.introspection import PERIOD, Introspection
from pdeloop.ros.suspend_watchdog import SuspendWatchdog

WAIT = 0.1
"""Seconds of one wait at most: a wait does not end by a signal."""
STUCK = 0.5
"""Seconds in which a loop goes round at least once, unless it computes."""
SUSPENDED = 2.0
"""Seconds without being scheduled after which a process takes its peers to have dropped it.

The DDS lease is 4 s, and announcements come every second: peers that stop hearing a participant
forget it, while it does not know and does not introduce itself again. Joining as a new participant is
the way back."""


PARAMETER_SERVICES = {
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
}
"""Services of rclpy itself, in which a malformed request ends in an exception."""


class EventLoop:
    """Holds a node's executor, and says when to stop."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.introspection = Introspection(node)
        self.suspended = False
        """True if `run` ended because the process had been suspended (SIGSTOP, a frozen machine)."""
        self.watchdog = SuspendWatchdog()
        """Of a node that ros_node made: it runs since before the node joined the network."""
        self._stop_reason: str | None = None
        self._turned = self.now()
        """Time of the last round of the loop."""
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)

    @staticmethod
    def now() -> float:
        """Monotonic time in s."""
        return time.monotonic()

    def stop(self, reason: str) -> None:
        """Leave `run` after the current event."""
        self._stop_reason = reason

    @contextmanager
    def watched(self, on_tick: Callable[[], None]) -> Iterator[None]:
        """The watchdog runs in the block, at the latest from its beginning, and calls on_tick."""
        running = nullcontext() if self.watchdog.running else self.watchdog
        with running, self.watchdog.calling(on_tick):
            yield

    def serve_next(self, seconds: float) -> bool:
        """Call the executor's next callback, after a wait of so long at most; whether there was one.

        A malformed request for parameters is refused.
        """
        entity: Any
        try:
            callback, entity, _ = self._executor.wait_for_ready_callbacks(timeout_sec=seconds)
        except (TimeoutException, ShutdownException):
            return False
        callback()
        try:
            callback.result()
        except Exception as error:
            name = entity.service_name if isinstance(entity, Service) else ""
            if name.rpartition("/")[2] not in PARAMETER_SERVICES:
                raise
            self.introspection.refuse(name, error)
        return True

    @property
    def stop_reason(self) -> str:
        """The last reason that `stop` was given; empty if none was."""
        return self._stop_reason or ""

    @property
    def stopped(self) -> bool:
        """True once `stop` was called or ROS was shut down."""
        return self._stop_reason is not None or not self.node.context.ok()


class Observer(EventLoop):
    """Runs one observing node until `stop`."""

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self.every(PERIOD, lambda: self.introspection.round(self.now()))

    def every(self, period: float, callback: Callable[[], None]) -> None:
        """Call `callback` every `period` s of real time, whatever the simulated time."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.node.create_timer(period, callback, clock=steady)

    def run(self) -> str:
        """Serve timers, subscriptions and services until `stop` or a signal; returns the reason."""
        self._turned = self.now()
        with self.watched(self._wake_if_stuck):
            while not self.stopped:
                self.serve_next(WAIT)
                self._turned = self.now()
                if not self.stopped and self.watchdog.longest() > SUSPENDED:
                    self.suspended = True
                    return "suspended"
        return self._stop_reason or "shutdown"

    def _wake_if_stuck(self) -> None:
        """In another thread: end a wait that takes too long, as NodeLoop does and for its reason."""
        if self.now() - self._turned > STUCK:
            self._executor.wake()
