# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The event loop of a node: raw array topics on a WaitSet, everything else on an executor.

A message of an array topic is taken as bytes, after a wait for the array subscriptions alone: by
rclpy's executor it would take ten times the processor time. Within an episode the messages of one
topic can be answered where they arrive, while this thread waits (`answer_fast`). Parameter services,
timers and whatever else the node has are served by an ordinary executor now and then
(`HOUSEKEEPING`). Array subscriptions are in a callback group that it never runs, so both share one
node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple, Protocol

from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from pdeloop.messages.frames import ArrayCodec, Frame
from pdeloop.messages.samples import ACTION_KIND, STATE_KIND
from pdeloop.messages.topics import ACTION, SAMPLES, STATE, Topic
from pdeloop.ros.endpoints import Receiver, SampleBatcher, Sender, reader_qos
from pdeloop.ros.observer import STUCK, SUSPENDED, WAIT, EventLoop
from pdeloop.ros.sample_subscription import SampleSubscription

HOUSEKEEPING = 0.05
"""Seconds between two rounds of the executor and of the node's slow duties."""
IDLE_HOUSEKEEPING = 0.5
"""The longest such period, in an idle node; a message or a request begins a round at once."""
IDLE_BACKOFF = 0.05
"""The period grows with the time since the last message or request, to this share of it."""
BUSY_HOUSEKEEPING = 0.15
"""The same while messages stream through: a round of the executor costs as much as ten of them."""
BUSY = 20
"""Messages since the last round that make a stream."""
SERVING = 0.02
"""Seconds in which a round begins callbacks of the executor: queued requests are answered together."""


class FastChannel(Protocol):
    """A subscription and a publisher that this thread shares with the middleware's: `RclChannel`."""

    def open(self, subscription: Any, publisher: Any, guard: Any) -> bool: ...
    def close(self) -> None: ...
    def next_message(self) -> bytes | None: ...
    def newly_dropped(self) -> int: ...


class FastPath(Protocol):
    """Answers one topic's messages on another while the node waits: `pdeloop.fast_path.handler`."""

    @property
    def channel(self) -> FastChannel: ...
    def arm(self) -> bool: ...
    def disarm(self) -> int: ...


class _Fast(NamedTuple):
    """A topic that is answered on another where its messages arrive."""

    receiver: Receiver
    sender: Sender
    path: FastPath


class _WaitSet:
    """The wait set of the loop: a guard condition, subscriptions and services, by their handles."""

    def __init__(
        self, node: Node, guard: Any, subscriptions: Sequence[Any], services: Sequence[Any]
    ) -> None:
        self._guard, self._subscriptions, self._services = guard, subscriptions, services
        sizes = len(subscriptions), 1, 0, 0, len(services), 0
        self._set = _rclpy.WaitSet(*sizes, node.context.handle)

    def wait(self, seconds: float) -> list[int]:
        """Wait for so long at most; pointers of the subscriptions and services that are ready."""
        wait_set = self._set
        wait_set.clear_entities()
        wait_set.add_guard_condition(self._guard)
        for handle in self._subscriptions:
            wait_set.add_subscription(handle)
        for service in self._services:
            wait_set.add_service(service)
        wait_set.wait(int(seconds * 1e9))
        ready: list[int] = wait_set.get_ready_entities("subscription")
        return ready + wait_set.get_ready_entities("service") if self._services else ready


Handler = tuple[Topic, Callable[[bytes], Frame], Callable[[Frame], None]]
"""A topic of samples, its decoder, and the callback for its frames."""


class NodeLoop(EventLoop):
    """Runs one node that answers messages until `stop`."""

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self._receivers: list[Receiver] = []
        self._batcher: SampleBatcher | None = None
        self._observed: list[tuple[SampleSubscription, dict[int, Handler]]] = []
        self._fast: _Fast | None = None
        self._guard = _rclpy.GuardCondition(node.context.handle)
        """Ends a wait: see `_end_long_wait`, and RclChannel."""
        self._takes: dict[Any, Callable[[], int]] = {}
        """Handlers of subscriptions by their handles, which return the number of messages."""
        self._handled, self._active, self._idle = 0, 0.0, False
        """Messages since the last round; when something last happened; whether that is long ago."""

    def sender(self, topic: Topic, namespace: str = "", *, sampled: bool = False) -> Sender:
        """A publisher of frames on `topic`; sampled: they are also published on `samples`."""
        return Sender(self.node, topic, namespace, self.batcher if sampled else None)

    def receive(
        self, topic: Topic, callback: Callable[[Frame], None], namespace: str = ""
    ) -> Receiver:
        """Call `callback` with every frame of `topic`; a ValueError it raises refuses the message."""
        receiver = Receiver(self.node, topic, callback, namespace)
        self._receivers.append(receiver)
        self.introspection.supervise(receiver.name, reader_qos(topic))
        return receiver

    def answer_fast(self, receiver: Receiver, sender: Sender, path: FastPath) -> None:
        """Let `path` answer messages of `receiver` on `sender` while this thread waits.

        Where rcl is not available, or the middleware does not announce messages, all of them go the
        ordinary way.
        """
        self._fast = _Fast(receiver, sender, path)

    def observe(
        self, namespace: str, on_state: Callable[[Frame], None], on_action: Callable[[Frame], None]
    ) -> None:
        """Call back with every state and action of a pair, without taking part in its loop.

        The loop neither waits for an observer nor repeats for it
        (pdeloop.ros.sample_subscription).
        """
        handlers: dict[int, Handler] = {
            STATE_KIND: (STATE, ArrayCodec(STATE.labels).decode, on_state),
            ACTION_KIND: (ACTION, ArrayCodec(ACTION.labels).decode, on_action),
        }
        self._observed.append((SampleSubscription(self.node, namespace), handlers))

    @property
    def batcher(self) -> SampleBatcher:
        """Publishes `samples`; made when it is first asked for."""
        if self._batcher is None:
            self._batcher = SampleBatcher(self.node)
        return self._batcher

    def resume(self) -> None:
        """Make `run` possible again after `stop`."""
        self._stop_reason = None

    def run(
        self,
        housekeeping: Callable[[float], None],
        *,
        tick: Callable[[float], None] = lambda now: None,
        deadline: Callable[[], float | None] = lambda: None,
    ) -> str:
        """Handle events until `stop` or a signal; returns the reason.

        housekeeping(now) is called every HOUSEKEEPING seconds, BUSY_HOUSEKEEPING, or less often while
        nothing happens; tick(now) when `deadline()` (monotonic s, or None) has passed.
        """
        self._turned = self._active = next_round = self.now()
        with self.watched(self._end_long_wait), self._fast_path_open() as fast:
            self._takes = self._subscriptions(fast)
            while self._stop_reason is None:
                self._turned = now = self.now()
                if now >= next_round:
                    if not self.node.context.ok():
                        break
                    if self.watchdog.longest() > SUSPENDED:
                        self.suspended = True
                        return "suspended"
                    next_round = now + self._round(now, fast, housekeeping)
                    continue
                due = deadline()
                if due is not None and now >= due:
                    tick(now)
                    continue
                wake = min(next_round, now + WAIT)
                if due is not None:
                    wake = min(wake, due)
                if fast is not None and not fast.path.arm():
                    self._handled += self._take_waiting(fast)
                    continue
                ready = self._wait_set.wait(wake - now)
                if fast is not None:
                    self._handled += fast.path.disarm()
                if self._idle:  # first a round: who is there may have changed
                    if ready or self._handled:
                        self._active = next_round = now
                    continue
                takes = [take for handle, take in self._takes.items() if handle.pointer in ready]
                self._handled += sum(take() for take in takes)
        self.introspection.log_refused()  # including those since the last report
        return self._stop_reason or "shutdown"

    def _round(
        self, now: float, fast: _Fast | None, housekeeping: Callable[[float], None]
    ) -> float:
        """Serve the executor and all slow duties; seconds until the next round."""
        if self._serve(now) or self._handled:
            self._active = now
        if self._batcher is not None:
            self._batcher.poll(now)
        changed = [samples.poll() for samples, _ in self._observed]
        if any(changed):
            self._takes = self._subscriptions(fast)
        housekeeping(now)
        self.introspection.round(now)
        period = BUSY_HOUSEKEEPING if self._handled > BUSY else HOUSEKEEPING
        backoff = min(IDLE_BACKOFF * (now - self._active), IDLE_HOUSEKEEPING)
        self._handled, self._idle = 0, backoff > period
        subscriptions, services = list(self._takes), []
        if self._idle:  # what the executor serves is much, and ends the waits of an idle node only
            able = self._executor.can_execute
            subscriptions += [s.handle for s in self.node.subscriptions if able(s)]
            services = [s.handle for s in self.node.services if able(s)]
        self._wait_set = _WaitSet(self.node, self._guard, subscriptions, services)
        return max(period, backoff)

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

    def _serve(self, now: float) -> bool:
        """Call the executor's callbacks that are ready; whether there were any."""
        served, any_served = True, False
        while served and not self.stopped and self.now() < now + SERVING:
            served = False
            while self.serve_next(0.0):  # what is ready now
                served = any_served = True
        return any_served

    def _end_long_wait(self) -> None:
        """In another thread: report a long computation, and end a wait that takes too long.

        Fast DDS waits until a point of the machine's clock where it was built with an old C++
        library, as the wheels are; if that clock is set back in the meantime, until it has caught up.
        """
        now = self.now()
        if now - self._turned > STUCK:
            self.introspection.round_while_working(now)
            self._guard.trigger_guard_condition()

    def _subscriptions(self, fast: _Fast | None) -> dict[Any, Callable[[], int]]:
        """Functions that take from each subscription, by its handle, those of samples first.

        A cost arrives after the samples of its episode, and must be handled after them.
        """
        found: dict[Any, Callable[[], int]] = {}
        for samples, handlers in self._observed:
            found |= dict.fromkeys(samples.handles, partial(self._drain, samples, handlers))
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
            reason = "arrived while too many others were waiting; it is sent again if needed"
            self.introspection.refuse(fast.receiver.name, reason, dropped)
        raw = channel.next_message()
        return 0 if raw is None else self._handle(fast.receiver, raw)

    def _drain(self, samples: SampleSubscription, handlers: dict[int, Handler]) -> int:
        """Handle all samples that have come in; how many."""
        count = 0
        try:
            for kind, _, raw in samples.drain():
                count += 1
                topic, decode, callback = handlers[kind]
                try:
                    callback(decode(raw))
                except ValueError as error:
                    self.introspection.refuse(topic.name, error)
        except ValueError as error:
            self.introspection.refuse(SAMPLES, error)
        return count
