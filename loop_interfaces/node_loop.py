"""The event loop of a node: raw array topics on a WaitSet, everything else on an executor.

The hot path takes serialised bytes from the middleware, decodes them with one `frombuffer`, and
publishes bytes; it is driven by a WaitSet of the node's array subscriptions alone. Parameter
services, timers and whatever else the node has are served by an ordinary executor now and then
(`HOUSEKEEPING`), off the critical path. Array subscriptions sit in a callback group that the
executor never runs, so both can share one node and ROS tools see one node.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray

from loop_interfaces.affinity import pin_process
from loop_interfaces.endpoints import Receiver, Sender
from loop_interfaces.frames import Frame
from loop_interfaces.topics import Topic

HOUSEKEEPING = 0.05
"""Seconds between two rounds of the executor and of the node's slow duties."""
BUSY_HOUSEKEEPING = 0.2
"""The same while messages stream through: a round of the executor costs as much as ten of them."""
BUSY = 20
"""Messages since the last round that make a stream."""
POLL = 200e-6
"""Seconds that a node with a core of its own polls for the next message before it waits: longer
than a round of a fast plant, shorter than what anyone would notice."""
LOOK = 1.0
"""Seconds between two looks at who publishes on the node's topics."""
SUSPENDED = 2.0
"""Seconds without being scheduled after which a process takes its peers to have dropped it.

The DDS lease is 3 s: peers that stop hearing a participant forget it, while it does not know and
does not introduce itself again. Joining as a new participant is the way back."""


class NodeLoop:
    """Runs one node until it is told to stop.

    refused counts the messages that were refused, by reason; new ones are reported through the
    node's logger at most once a second.
    """

    def __init__(self, node: Node) -> None:
        self.node = node
        self.refused: Counter[str] = Counter()
        self._receivers: list[Receiver] = []
        self._stop_reason: str | None = None
        self._poll = 0.0
        self.suspended = False
        """Whether `run` ended because the process had been suspended (SIGSTOP, a frozen machine)."""
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._last_reason = ""
        self._reported = 0
        self._report_at = 0.0
        self._look_at = 0.0

    def sender(self, topic: Topic, namespace: str = "") -> Sender:
        """A publisher of frames on `topic`."""
        return Sender(self.node, topic, namespace)

    def receive(
        self, topic: Topic, callback: Callable[[Frame], None], namespace: str = ""
    ) -> Subscription:
        """Call `callback` with every frame of `topic`; a ValueError it raises refuses the message."""
        receiver = Receiver(self.node, topic, callback, namespace)
        self._receivers.append(receiver)
        return receiver.subscription

    def observe(
        self, topic: Topic, callback: Callable[[Frame], None], namespace: str = ""
    ) -> Subscription:
        """Like `receive`, for somebody who watches a loop without taking part in it.

        Best effort with a deep history: the loop neither waits for an observer nor repeats for it.
        """
        receiver = Receiver(self.node, topic, callback, namespace, observer=True)
        self._receivers.append(receiver)
        return receiver.subscription

    @staticmethod
    def now() -> float:
        """Monotonic time in s, as handed to `tick` and `housekeeping`."""
        return time.monotonic()

    def stop(self, reason: str) -> None:
        """Leave `run` after the present event."""
        self._stop_reason = reason

    def pin(self, core: int) -> None:
        """Stay on one core and poll before waiting; -1: neither. ValueError for a core not allowed."""
        if core >= 0:
            pin_process(core)
            self._poll = POLL

    def resume(self) -> None:
        """Make `run` possible again after `stop`."""
        self._stop_reason = None

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called or ROS was shut down."""
        return self._stop_reason is not None or not self.node.context.ok()

    def run(
        self,
        *,
        tick: Callable[[float], None],
        deadline: Callable[[], float | None],
        housekeeping: Callable[[float], None],
    ) -> str:
        """Handle events until `stop` or a signal; returns the reason.

        tick(now) is called when `deadline()` (monotonic s, or None) has passed; housekeeping(now)
        every HOUSEKEEPING seconds, or BUSY_HOUSEKEEPING.
        """
        context = self.node.context
        receivers, clock = self._receivers, time.monotonic
        wait_set = _rclpy.WaitSet(len(receivers), 0, 0, 0, 0, 0, context.handle)
        handles = [receiver.handle for receiver in receivers]
        by_pointer = {receiver.handle.pointer: receiver for receiver in receivers}
        clear, add = wait_set.clear_entities, wait_set.add_subscription
        wait, ready = wait_set.wait, wait_set.get_ready_entities
        next_round = clock()
        last_round, cpu = next_round, time.process_time()
        poll_until, handled = 0.0, 0
        while self._stop_reason is None:
            now = clock()
            if now >= next_round:
                if not context.ok():
                    break
                gap, worked = now - last_round, time.process_time() - cpu
                if gap > SUSPENDED and worked < gap / 2:
                    self.suspended = True
                    return "suspended"
                last_round, cpu = now, cpu + worked
                self._executor.spin_once(timeout_sec=0)
                housekeeping(now)
                self._report(now)
                self._look_for_strangers(now)
                next_round = now + (BUSY_HOUSEKEEPING if handled > BUSY else HOUSEKEEPING)
                handled = 0
                continue
            due = deadline()
            if due is not None and now >= due:
                tick(now)
                continue
            if now < poll_until:
                for receiver in receivers:
                    if self._take(receiver):
                        handled += 1
                        poll_until = clock() + self._poll
                continue
            # Never longer than HOUSEKEEPING: a wait does not end by a signal.
            wake = min(next_round, now + HOUSEKEEPING)
            if due is not None:
                wake = min(wake, due)
            clear()
            for handle in handles:
                add(handle)
            wait(int((wake - now) * 1e9))
            for pointer in ready("subscription"):
                receiver = by_pointer[pointer]
                while self._take(receiver) and receiver.observer:
                    handled += 1
                handled += 1
                if self._poll:
                    poll_until = clock() + self._poll
        return self._stop_reason or "shutdown"

    def _take(self, receiver: Receiver) -> bool:
        """Handle the next message of `receiver`; False if there is none."""
        taken = receiver.take(Float64MultiArray, True)
        if taken is None:
            return False
        try:
            receiver.callback(receiver.decode(taken[0]))
        except ValueError as error:
            self._last_reason = f"{receiver.subscription.topic_name}: {error}"[:300]
            self.refused[self._last_reason] += 1
            if len(self.refused) > 1000:  # a flood with ever new reasons must not grow memory
                self.refused = Counter({"others": sum(self.refused.values())})
        return True

    def _look_for_strangers(self, now: float) -> None:
        """Say who else publishes what one node of the loop should publish."""
        if now < self._look_at:
            return
        self._look_at = now + LOOK
        for receiver in self._receivers:
            topic = receiver.subscription.topic_name
            if self.node.count_publishers(topic) < 2:
                continue
            found = {
                f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
                for endpoint in self.node.get_publishers_info_by_topic(topic)
            }
            if len(found) > 1:
                self.node.get_logger().warning(
                    f"{len(found)} nodes publish {topic}: {', '.join(sorted(found))}; "
                    "only messages of this run, episode, step and plant count",
                    throttle_duration_sec=10.0,
                )

    def _report(self, now: float) -> None:
        total = sum(self.refused.values())
        if total > self._reported and now >= self._report_at:
            self.node.get_logger().warning(
                f"refused {total - self._reported} message(s), the last one because: "
                f"{self._last_reason}"
            )
            self._reported = total
            self._report_at = now + 1.0
