"""One subscription and one publisher inside compiled functions, without rclpy in between.

What rclpy does for a message, a WaitSet, `take` and `publish`, is a call each of rcl, ROS 2's C
library, which is the same for every middleware. Within an episode a node does nothing else, so a
compiled function may do it, round after round, and leave the interpreter out. Whatever is unusual
goes back to rclpy: the message that was taken last is in `Line.message`.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import numpy as np

from loop_interfaces.compiled import jit
from loop_interfaces.native import call_c
from loop_interfaces.simd import read_word, write_word

if TYPE_CHECKING:
    from rclpy.node import Node

__all__ = [
    "LINE",
    "Line",
    "monotonic_ns",
    "received",
    "send",
    "wait",
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
        # and of libc,
        ("gettime", np.int64),  # clock_gettime
        ("give_way", np.int64),  # sched_yield
        # of rclpy's objects,
        ("wait_set", np.int64),
        ("subscription", np.int64),
        ("publisher", np.int64),
        ("guard", np.int64),
        # and of our own.
        ("incoming", np.int64),  # an rcl_serialized_message_t
        ("outgoing", np.int64),
        ("moment", np.int64),  # a timespec
        ("poll", np.int64),  # ns to look for a message before waiting for it
    ]
)
BUFFER, LENGTH = 0, 1
"""Words of an rcl_serialized_message_t."""
CLOCK_MONOTONIC = 1


@jit
def monotonic_ns(line: Any) -> int:
    """Nanoseconds on the clock of time.monotonic_ns."""
    call_c(line.gettime, (CLOCK_MONOTONIC, line.moment))
    nanoseconds: int = 1_000_000_000 * read_word(line.moment, 0) + read_word(line.moment, 1)
    return nanoseconds


@jit
def wait(line: Any, patience: int) -> bool:
    """Take the next message; False if none comes in so many nanoseconds."""
    take = (line.subscription, line.incoming, 0, 0)
    if line.poll > 0:
        end = monotonic_ns(line) + line.poll
        while monotonic_ns(line) < end:
            if call_c(line.take, take) == 0:
                return True
            call_c(line.give_way, (0,))
    call_c(line.clear, (line.wait_set,))
    call_c(line.add, (line.wait_set, line.subscription, 0))
    call_c(line.add_guard, (line.wait_set, line.guard, 0))
    call_c(line.wait, (line.wait_set, patience))
    return bool(call_c(line.take, take) == 0)


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


class _Allocator(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_void_p)
        for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")
    ]


class _Message(ctypes.Structure):
    """rcl_serialized_message_t."""

    _fields_ = [
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", _Allocator),
    ]


class Line:
    """Reads with one subscription and writes with one publisher of rclpy; a guard condition ends its
    waits.

    records: what the compiled functions want, one entry of LINE; valid as long as this object and the
    node are. Only one thread may use it, and nobody else that subscription and publisher meanwhile.

    Raises OSError or AttributeError where rcl is not to be had.
    """

    def __init__(
        self, node: Node, subscription: Any, publisher: Any, guard: Any, *, poll: float = 0.0
    ) -> None:
        # Here, so that what only compares and fills in needs no ROS.
        from rclpy.impl.implementation_singleton import rclpy_implementation

        rcl, rcutils = ctypes.CDLL("librcl.so"), ctypes.CDLL("librcutils.so")
        rcutils.rcutils_get_default_allocator.restype = _Allocator
        allocator = rcutils.rcutils_get_default_allocator()
        # rcl makes room in the one, and only reads the other.
        self._incoming, self._outgoing = (_Message(None, 0, 0, allocator) for _ in range(2))
        self._free = rcutils.rcutils_uint8_array_fini
        self._moment = np.zeros(2, np.int64)
        self._wait_set = rclpy_implementation.WaitSet(1, 1, 0, 0, 0, 0, node.context.handle)
        self._held = subscription, publisher, guard
        self.records = np.zeros(1, LINE)
        record = self.records[0]
        for field, name in (
            ("clear", "rcl_wait_set_clear"),
            ("add", "rcl_wait_set_add_subscription"),
            ("add_guard", "rcl_wait_set_add_guard_condition"),
            ("wait", "rcl_wait"),
            ("take", "rcl_take_serialized_message"),
            ("publish", "rcl_publish_serialized_message"),
        ):
            record[field] = address_of(getattr(rcl, name))
        record["gettime"] = address_of(ctypes.CDLL(None).clock_gettime)
        record["give_way"] = address_of(ctypes.CDLL(None).sched_yield)
        record["wait_set"] = self._wait_set.pointer
        record["subscription"], record["publisher"] = subscription.pointer, publisher.pointer
        record["guard"] = guard.pointer
        record["incoming"] = ctypes.addressof(self._incoming)
        record["outgoing"] = ctypes.addressof(self._outgoing)
        record["moment"] = self._moment.ctypes.data
        record["poll"] = int(poll * 1e9)

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
