"""One subscription and one publisher inside compiled functions, without rclpy in between.

What rclpy does for a message, a WaitSet, `take` and `publish`, is a call each of rcl, ROS 2's C
library, which is the same for every middleware. Within an episode a node does nothing else, so a
compiled function may do it, round after round, and leave the interpreter out. Whatever is unusual
goes back to rclpy: the message that was taken last is in `Line.message`.

The thread of the middleware that receives a message deals with it, so that it need not wake another
one (`attendance`). It and the node's own thread take turns. Four words say whose it is:

PENDING  messages that were announced since somebody last looked. Who counts it up from 0 has the
         stream until it is 0 again; while the node's own thread has it, it stays above.
ENDED    why no more messages are wanted, GOING while they are.
STOP     the node's own thread asks for the stream.
BACK     it has it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np
from numba import types

from loop_interfaces.jit.atomics import add, look, set_word
from loop_interfaces.jit.cache import jit
from loop_interfaces.jit.native import call_c
from loop_interfaces.jit.simd import read_word, write_word
from loop_interfaces.protocol import QUIET

if TYPE_CHECKING:
    from rclpy.node import Node

__all__ = [
    "GOING",
    "LINE",
    "Doorbell",
    "Ear",
    "Line",
    "announcement",
    "attendance",
    "monotonic_ns",
    "received",
    "send",
]

LINE = np.dtype(
    [
        # Addresses of functions of rcl,
        ("clear", np.int64),  # rcl_wait_set_clear
        ("add", np.int64),  # rcl_wait_set_add_subscription
        ("add_guard", np.int64),  # rcl_wait_set_add_guard_condition
        ("wait", np.int64),  # rcl_wait
        ("take", np.int64),  # rcl_take_serialized_message
        ("publish", np.int64),  # rcl_publish_serialized_message
        ("trigger", np.int64),  # rcl_trigger_guard_condition
        # and of libc,
        ("gettime", np.int64),  # clock_gettime
        # of rclpy's objects,
        ("wait_set", np.int64),
        ("subscription", np.int64),
        ("publisher", np.int64),
        ("guard", np.int64),
        # and of our own.
        ("incoming", np.int64),  # an rcl_serialized_message_t
        ("outgoing", np.int64),
        ("moment", np.int64),  # a timespec
        ("turns", np.int64),  # address of the four words
        ("announces", np.int64),  # whether the middleware calls `announced`
    ]
)
PENDING, ENDED, STOP, BACK = range(0, 32, 8)
GOING = -1
BUFFER, LENGTH = 0, 1
"""Words of an rcl_serialized_message_t."""
CLOCK_MONOTONIC = 1
LONG = 100_000_000
"""Nanoseconds; longer than a step that compiled functions do by themselves."""


@jit
def monotonic_ns(line: Any) -> int:
    """Nanoseconds on the clock of time.monotonic_ns."""
    call_c(line.gettime, (CLOCK_MONOTONIC, line.moment))
    nanoseconds: int = 1_000_000_000 * read_word(line.moment, 0) + read_word(line.moment, 1)
    return nanoseconds


@jit
def take(line: Any) -> bool:
    return bool(call_c(line.take, (line.subscription, line.incoming, 0, 0)) == 0)


@jit
def sleep(line: Any, until: int) -> None:
    """Wait for the guard condition, and for a message if the middleware does not announce them."""
    call_c(line.clear, (line.wait_set,))
    if not line.announces:
        call_c(line.add, (line.wait_set, line.subscription, 0))
    call_c(line.add_guard, (line.wait_set, line.guard, 0))
    # A time below zero would be for ever.
    call_c(line.wait, (line.wait_set, max(until - monotonic_ns(line), 0)))


@jit
def wait(line: Any, until: int) -> bool:
    """Take the next message; False if there is none until then on the clock of monotonic_ns."""
    sleep(line, until)
    return take(line)


@jit
def received(line: Any) -> tuple[int, int]:
    """Address and length of the message that was taken last."""
    return read_word(line.incoming, BUFFER), read_word(line.incoming, LENGTH)


@jit
def send(line: Any, message: int, length: int) -> None:
    """Publish the serialised message at an address; it may be overwritten afterwards."""
    write_word(line.outgoing, BUFFER, message)
    write_word(line.outgoing, LENGTH, length)
    call_c(line.publish, (line.publisher, line.outgoing, 0))


def announcement(plan: Any) -> Any:
    """Signature of machine code that is called with a kind of plan and a number of messages."""
    plans = types.CPointer(numba.from_dtype(plan))  # type: ignore[no-untyped-call]
    return types.void(plans, types.intp)


def attendance(deal: Callable[[Any, Any], int]) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compiled functions that have messages dealt with: `attend` and `announced`.

    deal(line, plan): compiled, what to do with the message that was taken; GOING, or why it ends.
    """

    @jit
    def deal_with_all(line: Any, plan: Any) -> bool:
        """As long as there are messages and they are wanted; whether that ends."""
        turns, seen = line.turns, 1
        while True:
            while look(turns + ENDED) == GOING and look(turns + STOP) == 0 and take(line):
                set_word(turns + ENDED, deal(line, plan))
            if look(turns + ENDED) != GOING or look(turns + STOP) != 0:
                return True  # what is pending stays, and so nobody else begins
            seen = add(turns + PENDING, -seen) - seen
            if seen == 0:
                return False

    @jit
    def announced(line: Any, plan: Any) -> None:
        """The middleware has a message, and calls in the thread that has received it."""
        turns = line.turns
        if add(turns + PENDING, 1) == 0 and deal_with_all(line, plan):
            set_word(turns + BACK, 1)
            call_c(line.trigger, (line.guard,))

    @jit
    def attend(line: Any, plan: Any, until: int) -> int:
        """Until then on the clock of monotonic_ns, or as long as it goes; why it ends."""
        if not line.announces:
            ended = GOING
            while ended == GOING:
                ended = deal(line, plan) if wait(line, until) else QUIET
            return ended
        turns = line.turns
        set_word(turns + ENDED, GOING)
        set_word(turns + STOP, 0)
        set_word(turns + BACK, 0)
        if not deal_with_all(line, plan):
            while look(turns + BACK) == 0:
                sleep(line, until)
                if look(turns + BACK) == 0:  # it is time, or something else has come
                    set_word(turns + STOP, 1)
                    if add(turns + PENDING, 1) == 0:
                        break
                    until = monotonic_ns(line) + LONG  # the other thread is about to give it back
        ended = look(turns + ENDED)
        return QUIET if ended == GOING else ended

    return attend, announced


class Doorbell:
    """Messages of some subscriptions trigger a guard condition, which ends the waits of a `Line`.

    So it need not wait for these subscriptions, each of which would cost with every wait. It is the
    middleware that rings, in a thread of its own, with no interpreter. Close it before they are
    destroyed. works: whether the middleware can do that.

    Raises OSError or AttributeError where rcl is not to be had.
    """

    def __init__(self, subscriptions: Sequence[Any], guard: Any) -> None:
        rcl = ctypes.CDLL("librcl.so")
        self._listen = rcl.rcl_subscription_set_on_new_message_callback
        self._listen.argtypes = [ctypes.c_void_p] * 3
        self._subscriptions: Sequence[Any] = ()
        # It is called with the guard condition and a number, which it does not look at.
        trigger = address_of(rcl.rcl_trigger_guard_condition)
        self.works = all(
            self._listen(subscription.pointer, trigger, guard.pointer) == 0
            for subscription in subscriptions
        )
        self._subscriptions = subscriptions

    def close(self) -> None:
        """From now on nothing rings."""
        for subscription in self._subscriptions:
            self._listen(subscription.pointer, None, None)
        self._subscriptions = ()


class Ear(NamedTuple):
    """What a line is for.

    line: an entry of LINE, for the line to fill in; announced: address of a function that calls
    `announced`; plan: what it is called with, an address; and with how many messages there are.
    """

    line: Any
    announced: int
    plan: int


class Line:
    """Reads with one subscription and writes with one publisher of rclpy; a guard condition ends its
    waits.

    What it fills in is valid as long as this object and the node are. While compiled functions
    `attend`, nobody else may use that subscription and publisher.

    Raises OSError or AttributeError where rcl is not to be had.
    """

    def __init__(
        self,
        node: Node,
        subscription: Any,
        publisher: Any,
        guard: Any,
        ear: Ear,
    ) -> None:
        # Here, so that what only compares and fills in needs no ROS.
        from rclpy.impl.implementation_singleton import rclpy_implementation

        from loop_interfaces.ros.rcl import Allocator, SerializedMessage

        rcl, rcutils = ctypes.CDLL("librcl.so"), ctypes.CDLL("librcutils.so")
        rcutils.rcutils_get_default_allocator.restype = Allocator
        allocator = rcutils.rcutils_get_default_allocator()
        # rcl makes room in the one, and only reads the other.
        self._incoming, self._outgoing = (
            SerializedMessage(None, 0, 0, allocator) for _ in range(2)
        )
        self._free = rcutils.rcutils_uint8_array_fini
        self._moment = np.zeros(2, np.int64)
        self._turns = np.array([1, GOING, 0, 1])  # the node's own
        self._wait_set = rclpy_implementation.WaitSet(1, 1, 0, 0, 0, 0, node.context.handle)
        self._held = subscription, publisher, guard
        self._ear, self._record = ear, ear.line
        record = self._record
        for field, name in (
            ("clear", "rcl_wait_set_clear"),
            ("add", "rcl_wait_set_add_subscription"),
            ("add_guard", "rcl_wait_set_add_guard_condition"),
            ("wait", "rcl_wait"),
            ("take", "rcl_take_serialized_message"),
            ("publish", "rcl_publish_serialized_message"),
            ("trigger", "rcl_trigger_guard_condition"),
        ):
            record[field] = address_of(getattr(rcl, name))
        record["gettime"] = address_of(ctypes.CDLL(None).clock_gettime)
        record["wait_set"] = self._wait_set.pointer
        record["subscription"], record["publisher"] = subscription.pointer, publisher.pointer
        record["guard"] = guard.pointer
        record["incoming"] = ctypes.addressof(self._incoming)
        record["outgoing"] = ctypes.addressof(self._outgoing)
        record["moment"] = self._moment.ctypes.data
        record["turns"] = self._turns.ctypes.data
        self._announce = rcl.rcl_subscription_set_on_new_message_callback
        self._announce.argtypes = [ctypes.c_void_p] * 3

    def open(self) -> None:
        """From now on the thread that receives a message deals with it, within `attend`. Close it
        before the subscription is destroyed.
        """
        _, announced, plan = self._ear
        subscription, *_ = self._held
        self._record["announces"] = self._announce(subscription.pointer, announced, plan) == 0

    def close(self) -> None:
        """From now on the thread that attends does."""
        if self._record["announces"]:
            subscription, *_ = self._held
            self._announce(subscription.pointer, None, None)
            self._record["announces"] = 0

    def message(self) -> bytes:
        """The message that was taken last."""
        return ctypes.string_at(self._incoming.buffer, self._incoming.length)

    def __del__(self) -> None:
        if hasattr(self, "_free"):
            self._free(ctypes.byref(self._incoming))


def address_of(function: Any) -> int:
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None
    return address
