"""The event loop of a node: raw array topics on a WaitSet, everything else on an executor.

The hot path takes serialised bytes from the middleware, decodes them with one `frombuffer`, and
publishes bytes; it is driven by a WaitSet of the node's array subscriptions alone. Within an episode
the messages of one topic can be answered where they arrive, while this thread waits
(`answer_fast`). Parameter services, timers and whatever else the node has are served by an ordinary
executor now and then (`HOUSEKEEPING`), off the critical path. Array subscriptions sit in a callback
group that the executor never runs, so both can share one node and ROS tools see one node.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from rclpy.executors import Executor, ShutdownException, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from loop_interfaces.affinity import pin_process
from loop_interfaces.frames import ArrayCodec, Frame
from loop_interfaces.ros.endpoints import Receiver, SampleBatcher, Sender
from loop_interfaces.ros.observer import STUCK, SUSPENDED, WAIT, EventLoop
from loop_interfaces.ros.sample_subscription import SampleSubscription
from loop_interfaces.ros.suspend_watchdog import SuspendWatchdog
from loop_interfaces.samples import ACTION_KIND, STATE_KIND
from loop_interfaces.topics import ACTION, SAMPLES, STATE, Topic

if TYPE_CHECKING:  # not every node needs the compiler
    from loop_interfaces.fast_path.handler import FastPath

HOUSEKEEPING = 0.05
"""Seconds between two rounds of the executor and of the node's slow duties."""
IDLE_HOUSEKEEPING = 0.5
"""The same, at most, in a node that has waited for long; whatever comes in begins a round at once."""
IMPATIENCE = 0.05
"""Share of the time it has waited after which a node looks around again."""
BUSY_HOUSEKEEPING = 0.15
"""The same while messages stream through: a round of the executor costs as much as ten of them."""
BUSY = 20
"""Messages since the last round that make a stream."""
SERVING = 0.02
"""Seconds in which a round begins callbacks of the executor: queued requests are answered together."""


@dataclass
class _Watched:
    """A pair whose samples are read: how its messages are decoded, and who is called with them."""

    samples: SampleSubscription
    callbacks: dict[int, tuple[Callable[[bytes], Frame], Callable[[Frame], None]]] = field(
        default_factory=dict
    )


class _Fast(NamedTuple):
    """A topic that is answered on another where its messages arrive."""

    receiver: Receiver
    sender: Sender
    path: FastPath


class _Sources:
    """What a node waits for: subscriptions, of which `takes` says how their messages are handled.

    executor: whose services and subscriptions end a wait, too; they are many, so only of an idle node.
    """

    def __init__(
        self,
        node: Node,
        guard: Any,
        takes: dict[Any, Callable[[], int]],
        executor: Executor | None = None,
    ) -> None:
        self.idle = executor is not None
        self._guard, self._handles, self._services = guard, list(takes), []
        self._takes = {handle.pointer: take for handle, take in takes.items()}
        if executor is not None:
            self._handles += [s.handle for s in node.subscriptions if executor.can_execute(s)]
            self._services = [s.handle for s in node.services if executor.can_execute(s)]
        self._set = _rclpy.WaitSet(
            len(self._handles), 1, 0, 0, len(self._services), 0, node.context.handle
        )

    def wait(self, seconds: float) -> list[int]:
        """Wait for so long at most; pointers of those that have something."""
        wait_set = self._set
        wait_set.clear_entities()
        wait_set.add_guard_condition(self._guard)
        for handle in self._handles:
            wait_set.add_subscription(handle)
        for service in self._services:
            wait_set.add_service(service)
        wait_set.wait(int(seconds * 1e9))
        ready: list[int] = wait_set.get_ready_entities("subscription")
        return ready + wait_set.get_ready_entities("service") if self.idle else ready

    def handle(self, ready: list[int]) -> int:
        """Handle messages of those subscriptions; how many."""
        return sum(self._takes[pointer]() for pointer in ready)


class NodeLoop(EventLoop):
    """Runs one node that answers messages until `stop`."""

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self._receivers: list[Receiver] = []
        self._batcher: SampleBatcher | None = None
        self._watched: dict[str, _Watched] = {}
        self._fast: _Fast | None = None
        self._guard = _rclpy.GuardCondition(node.context.handle)
        """Ends a wait: see `_look_after`, and RclChannel."""

    def sender(self, topic: Topic, namespace: str = "", *, sampled: bool = False) -> Sender:
        """A publisher of frames on `topic`; sampled: they go out on `samples`, too."""
        return Sender(self.node, topic, namespace, self.batcher if sampled else None)

    def receive(
        self, topic: Topic, callback: Callable[[Frame], None], namespace: str = ""
    ) -> Receiver:
        """Call `callback` with every frame of `topic`; a ValueError it raises refuses the message."""
        receiver = Receiver(self.node, topic, callback, namespace)
        self._receivers.append(receiver)
        self.introspection.supervise(receiver.name, topic)
        return receiver

    def answer_fast(self, receiver: Receiver, sender: Sender, path: FastPath) -> None:
        """Let `path` answer messages of `receiver` on `sender` while this thread waits.

        Where rcl is not to be had, or the middleware does not announce messages, all of them go the
        ordinary way.
        """
        self._fast = _Fast(receiver, sender, path)

    def observe(self, topic: Topic, callback: Callable[[Frame], None], namespace: str = "") -> None:
        """Call `callback` with every state or action, without taking part in the loop.

        The loop neither waits for an observer nor repeats for it
        (loop_interfaces.ros.sample_subscription).
        """
        watched = self._watched.get(namespace)
        if watched is None:
            watched = self._watched[namespace] = _Watched(SampleSubscription(self.node, namespace))
        kind = {STATE: STATE_KIND, ACTION: ACTION_KIND}[topic]
        watched.callbacks[kind] = (ArrayCodec(topic.labels).decode, callback)

    @property
    def batcher(self) -> SampleBatcher:
        """Publishes `samples`; made when it is first asked for."""
        if self._batcher is None:
            self._batcher = SampleBatcher(self.node)
        return self._batcher

    def pin(self, core: int) -> None:
        """Stay on one core; -1: on any. ValueError for a core not allowed."""
        if core >= 0:
            pin_process(core)

    def resume(self) -> None:
        """Make `run` possible again after `stop`."""
        self._stop_reason = None

    def run(
        self,
        *,
        tick: Callable[[float], None],
        deadline: Callable[[], float | None],
        housekeeping: Callable[[float], None],
    ) -> str:
        """Handle events until `stop` or a signal; returns the reason.

        tick(now) is called when `deadline()` (monotonic s, or None) has passed; housekeeping(now)
        every HOUSEKEEPING seconds, BUSY_HOUSEKEEPING, or less often while nothing happens.
        """
        self._turned = self.now()
        with SuspendWatchdog(self._look_after) as watchdog, self._fast_path_open() as fast:
            return self._handle_events(watchdog, fast, tick, deadline, housekeeping)

    @contextmanager
    def _fast_path_open(self) -> Iterator[_Fast | None]:
        """The fast path, if there is one and it works here."""
        fast, opened = self._fast, False
        if fast is None:
            yield None
            return
        channel = fast.path.channel
        try:
            opened = channel.open(fast.receiver.handle, fast.sender.publisher.handle, self._guard)
        except (OSError, AttributeError) as error:
            self.node.get_logger().warning(f"the loop is slower than it could be: {error}")
        try:
            yield fast if opened else None
        finally:
            channel.close()

    def _handle_events(
        self,
        watchdog: SuspendWatchdog,
        fast: _Fast | None,
        tick: Callable[[float], None],
        deadline: Callable[[], float | None],
        housekeeping: Callable[[float], None],
    ) -> str:
        context = self.node.context
        clock = time.monotonic
        takes = self._takes(fast)
        sources = _Sources(self.node, self._guard, takes)
        next_round = active = clock()
        handled = 0
        while self._stop_reason is None:
            self._turned = now = clock()
            if now >= next_round:
                if not context.ok():
                    break
                if watchdog.longest() > SUSPENDED:
                    self.suspended = True
                    return "suspended"
                if self._serve(now) or handled:
                    active = now
                if self._batcher is not None:
                    self._batcher.poll(now)
                changed = [watched.samples.poll() for watched in self._watched.values()]
                if any(changed):
                    takes = self._takes(fast)
                housekeeping(now)
                self.introspection.round(now)
                period = BUSY_HOUSEKEEPING if handled > BUSY else HOUSEKEEPING
                idle = min(IMPATIENCE * (now - active), IDLE_HOUSEKEEPING)
                next_round = now + max(period, idle)
                executor = self._executor if idle > period else None
                sources = _Sources(self.node, self._guard, takes, executor)
                handled = 0
                continue
            due = deadline()
            if due is not None and now >= due:
                tick(now)
                continue
            wake = min(next_round, now + WAIT)
            if due is not None:
                wake = min(wake, due)
            if fast is not None and not fast.path.arm():
                handled += self._take_waiting(fast)
                continue
            ready = sources.wait(wake - now)
            if fast is not None:
                handled += fast.path.disarm()
            if sources.idle:  # first a round: who is there may have changed
                if ready or handled:
                    active = next_round = now
                continue
            handled += sources.handle(ready)
        return self._stop_reason or "shutdown"

    def _serve(self, now: float) -> bool:
        """Call the executor's callbacks that are ready; whether there were any."""
        served, any_served = True, False
        while served and not self.stopped and self.now() < now + SERVING:
            served = False
            with suppress(TimeoutException, ShutdownException):
                while True:  # what is ready now; then a TimeoutException
                    callback, _, _ = self._executor.wait_for_ready_callbacks(timeout_sec=0)
                    callback()
                    callback.result()
                    served = any_served = True
        return any_served

    def _look_after(self) -> None:
        """In another thread: report a long computation, and end a wait that takes too long.

        Fast DDS waits until a point of the machine's clock where it was built with an old C++
        library, as the wheels are; when that clock is set back meanwhile, until it gets there again.
        """
        now = self.now()
        if now - self._turned > STUCK:
            self.introspection.round_while_working(now)
            self._guard.trigger_guard_condition()

    def _takes(self, fast: _Fast | None) -> dict[Any, Callable[[], int]]:
        """What to wait for, and what takes from it, the watched subscriptions first.

        A cost comes after the samples of its episode, and is to be handled after them.
        """
        found: dict[Any, Callable[[], int]] = {}
        for watched in self._watched.values():
            for handle in watched.samples.handles:
                found[handle] = partial(self._drain, watched)
        for receiver in self._receivers:
            if fast is None or receiver is not fast.receiver:
                found[receiver.handle] = partial(self._take, receiver)
        return found

    def _take(self, receiver: Receiver) -> int:
        """Handle the next message of `receiver`; how many there were."""
        taken = receiver.take(Float64MultiArray, True)
        return 0 if taken is None else self._handle(receiver, taken[0])

    def _handle(self, receiver: Receiver, raw: bytes) -> int:
        """Handle a message of `receiver`; 1."""
        try:
            receiver.callback(receiver.decode(raw))
        except ValueError as error:
            self.introspection.refuse(receiver.name, error)
        return 1

    def _take_waiting(self, fast: _Fast) -> int:
        """Handle the message that has waited longest; how many there were."""
        channel = fast.path.channel
        if dropped := channel.newly_dropped():
            reason = "came while too many others waited"
            self.introspection.refuse(fast.receiver.name, reason, dropped)
        raw = channel.next_message()
        return 0 if raw is None else self._handle(fast.receiver, raw)

    def _drain(self, watched: _Watched) -> int:
        """Handle all samples that have come in; how many."""
        count = 0
        try:
            for kind, _, raw in watched.samples.drain():
                count += 1
                if kind in watched.callbacks:
                    decode, callback = watched.callbacks[kind]
                    try:
                        callback(decode(raw))
                    except ValueError as error:
                        name = "state" if kind == STATE_KIND else "action"
                        self.introspection.refuse(name, error)
        except ValueError as error:
            self.introspection.refuse(SAMPLES, error)
        return count
