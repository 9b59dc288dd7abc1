"""The event loop of a node that observes: ordinary rclpy timers and subscriptions.

The nodes that answer states have one of their own (loop_interfaces.ros.node_loop). This one serves
whatever the node has on rclpy's executor, publishes its /diagnostics, and ends by a signal, on
request, or when the process was suspended for so long that its peers have forgotten it.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from loop_interfaces.diagnostics import Health
from loop_interfaces.ros.introspection import PERIOD, Introspection
from loop_interfaces.ros.node_loop import STUCK, SUSPENDED
from loop_interfaces.ros.suspend_watchdog import SuspendWatchdog

WAIT = 0.1
"""Seconds of one wait at most: a wait does not end by a signal."""


class Observer:
    """Runs one observing node until it is told to stop."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.suspended = False
        """Whether `run` ended because the process had been suspended (SIGSTOP, a frozen machine)."""
        self._stop_reason: str | None = None
        self._turned = self.now()
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._introspection = Introspection(node, refused=lambda: (0, ""), topics={})
        self.every(PERIOD, lambda: self._introspection.round(self.now()))

    def every(self, period: float, callback: Callable[[], None]) -> None:
        """Call `callback` every `period` s of real time, whatever the simulated time."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.node.create_timer(period, callback, clock=steady)

    def diagnose(self, task: str, health: Callable[[float], Health]) -> None:
        """Publish what `health(now)` says on /diagnostics, once a second."""
        self._introspection.report(task, health)

    @staticmethod
    def now() -> float:
        """Monotonic time in s."""
        return time.monotonic()

    def stop(self, reason: str) -> None:
        """Leave `run` after the present callback."""
        self._stop_reason = reason

    def run(self) -> str:
        """Serve timers, subscriptions and services until `stop` or a signal; returns the reason."""
        self._turned = self.now()
        with SuspendWatchdog(self._wake_if_stuck) as watchdog:
            while self._stop_reason is None and self.node.context.ok():
                self._executor.spin_once(timeout_sec=WAIT)
                self._turned = self.now()
                if watchdog.longest() > SUSPENDED:
                    self.suspended = True
                    return "suspended"
        return self._stop_reason or "shutdown"

    def _wake_if_stuck(self) -> None:
        """In another thread: end a wait that takes too long, as NodeLoop does and for its reason."""
        if self.now() - self._turned > STUCK:
            self._executor.wake()
