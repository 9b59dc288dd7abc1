# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One subscription and one publisher shared by the middleware's thread and the node's own thread.

Only the middleware's thread takes from the subscription, in the callback with which the middleware
announces a message (rcl_subscription_set_on_new_message_callback; one call at a time). While the
channel is armed, compiled code answers the message at once. Otherwise it goes into a mailbox for the
node's own thread::

    middleware's thread                            node's own thread
      on_new_message:                                disarm:
        while there is a message:                        armed = false
            lock; take it                                lock; unlock
            if not (armed and answered):             next_message:
                armed = false                            lock; remove the oldest; unlock
                put it into the mailbox              arm:
                trigger the guard condition              lock
            unlock                                       while the oldest is answered: remove it
                                                         armed = the mailbox is empty
                                                         unlock

While the channel is armed, what the handler works on belongs to the middleware's thread; while it is
not, to the node's, which arms it before it waits and disarms it when it wakes up. A message that has
to wait disarms, so that later ones queue up behind it, and the channel is never armed before the
mailbox is empty. The guard condition stays triggered until the node's thread has waited for it, so
no message stays in the mailbox.

The lock is a POSIX mutex: locking acquires, unlocking releases, on every architecture. What both
threads touch is touched under it, but for the store with which `disarm` begins: it orders nothing,
and sees to it that the node's thread waits for one answer only. `tests/fast_path/test_channel_model.py`
explores all interleavings.

The mailbox is bounded. What it cannot hold is dropped and counted; lock-step sends it again.
"""

import ctypes
from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined, unused-ignore]
from numpy.typing import NDArray

from pdeloop.jit import cache, native, simd
from pdeloop.jit.cache import cached_njit, jit
from pdeloop.jit.native import (
    CLOCK,
    MachineCode,
    MonotonicClock,
    address_of,
    call_c,
    load_acquire,
    monotonic_ns,
    pointer_to,
    store_release,
)
from pdeloop.jit.simd import read_word

CHANNEL = np.dtype(
    [
        # Addresses of functions of rcl and of the POSIX threads,
        ("take", np.int64),  # rcl_take_serialized_message
        ("publish", np.int64),  # rcl_publish_serialized_message
        ("trigger", np.int64),  # rcl_trigger_guard_condition
        ("lock", np.int64),  # pthread_mutex_lock
        ("unlock", np.int64),  # pthread_mutex_unlock
        # of the objects that they are called with,
        ("subscription", np.int64),
        ("publisher", np.int64),
        ("guard", np.int64),
        ("mutex", np.int64),
        ("answer", np.int64),  # the rcl_serialized_message_t that is published
        ("clock", CLOCK),
        # and of the handler, see RclChannel.
        ("handle", np.int64),
        ("plan", np.int64),
        ("armed", np.int64),  # address of a word: whether the handler may answer
        # The mailbox, a ring.
        ("slots", np.int64),  # address of CAPACITY + 1 rcl_serialized_message_t
        ("first", np.int64),  # slot of the message that has waited longest
        ("waiting", np.int64),  # how many messages wait
        ("dropped", np.int64),  # how many it could not hold
        # Messages answered since the channel was armed.
        ("answered", np.int64),
        ("answered_at", np.int64),  # the last one; ns on the monotonic clock
    ]
)
SOURCES = cache, simd, native
CAPACITY = 16
"""Capacity of the mailbox, in messages: twice the middleware's for a reader of its own."""
SLOTS = CAPACITY + 1
LARGE = 2**20
"""Bytes of a message in the mailbox whose memory is given back as soon as it was read."""
SLOT_BYTES, BUFFER, LENGTH = 64, 0, 1
"""Size of an rcl_serialized_message_t, and the two of its words that are used."""
MUTEX_BYTES = 64
"""At least sizeof(pthread_mutex_t): 40 on x86-64, 48 on aarch64."""


class Allocator(ctypes.Structure):
    """rcutils_allocator_t."""

    _fields_ = [
        (name, ctypes.c_void_p)
        for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")
    ]


class SerializedMessage(ctypes.Structure):
    """rcl_serialized_message_t."""

    _fields_ = [
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", Allocator),
    ]


@jit
def slot_after(channel: Any, messages: int) -> int:
    """Address of the slot this many messages after the first."""
    slot: int = channel.slots + SLOT_BYTES * ((channel.first + messages) % SLOTS)
    return slot


@jit
def lock(channel: Any) -> None:
    """Wait for the channel's mutex and take it."""
    call_c(channel.lock, (channel.mutex,))


@jit
def unlock(channel: Any) -> None:
    """Release the channel's mutex."""
    call_c(channel.unlock, (channel.mutex,))


@jit
def answered(channel: Any, message: int) -> bool:
    """Let the handler answer the message in a slot, and publish the answer."""
    raw, length = read_word(message, BUFFER), read_word(message, LENGTH)
    if call_c(channel.handle, (channel.plan, raw, length)) == 0:
        return False
    call_c(channel.publish, (channel.publisher, channel.answer, 0))
    channel.answered += 1
    channel.answered_at = monotonic_ns(channel.clock)
    return True


@jit
def put_into_mailbox(channel: Any) -> None:
    """The message in the slot behind the last one has to wait."""
    store_release(channel.armed, 0)
    if channel.waiting < CAPACITY:
        channel.waiting += 1
    else:
        channel.dropped += 1
    call_c(channel.trigger, (channel.guard,))


@jit
def remove_oldest(channel: Any) -> None:
    """Drop the oldest message of the mailbox."""
    channel.first = (channel.first + 1) % SLOTS
    channel.waiting -= 1


@jit
def on_message(channel: Any) -> bool:
    """Take a message, and answer it or let it wait; False if there is none."""
    lock(channel)
    message = slot_after(channel, channel.waiting)
    found = call_c(channel.take, (channel.subscription, message, 0, 0)) == 0
    if found and not (load_acquire(channel.armed) == 1 and answered(channel, message)):
        put_into_mailbox(channel)
    unlock(channel)
    return bool(found)


def on_messages(channels: Any, count: int) -> None:
    """The middleware's callback: `on_message` for each message that arrived."""
    channel = carray(channels, 1)[0]
    while on_message(channel):
        pass


on_new_message = MachineCode(on_messages, types.void(pointer_to(CHANNEL), types.intp), *SOURCES)


# Calls of the node's own thread.


@cached_njit(*SOURCES)
def disarm(channels: NDArray[np.void]) -> None:
    """Let every message wait from now on."""
    channel = channels[0]
    store_release(channel.armed, 0)  # no answer is begun from here on
    lock(channel)  # the one under way has been given
    unlock(channel)


@cached_njit(*SOURCES)
def arm(channels: NDArray[np.void]) -> bool:
    """Answer what waits already; whether that was all, and it is armed."""
    channel = channels[0]
    lock(channel)
    channel.answered = 0
    while channel.waiting > 0 and answered(channel, slot_after(channel, 0)):
        remove_oldest(channel)
    empty = channel.waiting == 0
    store_release(channel.armed, 1 if empty else 0)
    unlock(channel)
    return bool(empty)


@cached_njit(*SOURCES)
def oldest(channels: NDArray[np.void]) -> int:
    """Address of the message that has waited longest; 0 if none waits."""
    channel = channels[0]
    lock(channel)
    message: int = slot_after(channel, 0) if channel.waiting > 0 else 0
    unlock(channel)
    return message


@cached_njit(*SOURCES)
def pop(channels: NDArray[np.void]) -> None:
    """The oldest message has been read."""
    channel = channels[0]
    lock(channel)
    remove_oldest(channel)
    unlock(channel)


def load_compiled() -> None:
    """Load what is compiled, or compile it."""
    on_new_message()
    channel = RclChannel(0, 0)
    channel.arm()
    channel.disarm()
    channel.next_message()
    pop(channel.record)


class RclChannel:
    """A subscription of rclpy that is answered on a publisher of rclpy; for the node's own thread.

    handle: address of machine code ``int handle(void *plan, const void *message, intptr_t
    length)``, which fills in the answer and returns 1, or leaves the message alone and returns 0;
    plan: the address that it is called with.
    """

    def __init__(self, handle: int, plan: int) -> None:
        self.record = np.zeros(1, CHANNEL)
        self._channel = channel = self.record[0]
        self._mutex = np.zeros(MUTEX_BYTES, np.uint8)
        self._armed = np.zeros(1, np.int64)
        self._clock = MonotonicClock(channel["clock"])
        # rcl makes room in the slots, and only reads the answer.
        self._slots = (SerializedMessage * SLOTS)()
        self._answer = SerializedMessage()
        self._held: tuple[Any, ...] = ()
        self._dropped = 0
        system = ctypes.CDLL(None)
        channel["lock"] = address_of(system.pthread_mutex_lock)
        channel["unlock"] = address_of(system.pthread_mutex_unlock)
        channel["mutex"] = self._mutex.ctypes.data
        channel["handle"], channel["plan"] = handle, plan
        channel["armed"] = self._armed.ctypes.data
        channel["answer"] = ctypes.addressof(self._answer)
        channel["slots"] = ctypes.addressof(self._slots)
        system.pthread_mutex_init.argtypes = [ctypes.c_void_p] * 2
        system.pthread_mutex_init(self._mutex.ctypes.data, None)

    def open(self, subscription: Any, publisher: Any, guard: Any) -> bool:
        """From now on messages arrive here, and nothing else may take from the subscription.

        subscription, publisher, guard: handles of rclpy's objects; the guard condition is triggered
        when a message has to wait. False where the middleware does not announce messages.

        Raises OSError or AttributeError if rcl is not available.
        """
        rcl, rcutils = ctypes.CDLL("librcl.so"), ctypes.CDLL("librcutils.so")
        rcutils.rcutils_get_default_allocator.restype = Allocator
        for slot in self._slots:
            slot.allocator = rcutils.rcutils_get_default_allocator()
        self._free = rcutils.rcutils_uint8_array_fini
        channel = self._channel
        channel["take"] = address_of(rcl.rcl_take_serialized_message)
        channel["publish"] = address_of(rcl.rcl_publish_serialized_message)
        channel["trigger"] = address_of(rcl.rcl_trigger_guard_condition)
        channel["subscription"], channel["publisher"] = subscription.pointer, publisher.pointer
        channel["guard"] = guard.pointer
        self._held = subscription, publisher, guard
        self._announce = rcl.rcl_subscription_set_on_new_message_callback
        self._announce.argtypes = [ctypes.c_void_p] * 3
        code = on_new_message()
        opened: bool = self._announce(subscription.pointer, code, self.record.ctypes.data) == 0
        if not opened:
            self._held = ()
        return opened

    def close(self) -> None:
        """No messages come any more. To be called before the subscription is destroyed."""
        if self._held:
            subscription, *_ = self._held
            self._announce(subscription.pointer, None, None)
            self._held = ()

    def answer_with(self, begin: int, length: int) -> None:
        """Set the address of the answer that the handler fills in, while the channel is not armed."""
        self._answer.buffer, self._answer.length = begin, length

    def arm(self) -> bool:
        """Answer what waits, and from now on every message at once.

        False if a message cannot be answered: it waits, and the channel is not armed.
        """
        return bool(arm(self.record))

    def disarm(self) -> tuple[int, float]:
        """Let every message wait from now on.

        Returns how many were answered since `arm`, and when the last one was, in s on the clock of
        time.monotonic.
        """
        disarm(self.record)
        return int(self._channel["answered"]), 1e-9 * float(self._channel["answered_at"])

    @property
    def waits(self) -> bool:
        """True while a message waits for the node's thread."""
        return bool(oldest(self.record) != 0)

    def next_message(self) -> bytes | None:
        """The message that has waited longest. Only while the channel is not armed."""
        message = oldest(self.record)
        if message == 0:
            return None
        slot = SerializedMessage.from_address(message)
        raw = ctypes.string_at(slot.buffer, slot.length)
        if slot.capacity > LARGE:
            self._free(ctypes.byref(slot))
        pop(self.record)
        return raw

    def newly_dropped(self) -> int:
        """Number of messages dropped by the full mailbox since the last call."""
        dropped = int(self._channel["dropped"])
        new, self._dropped = dropped - self._dropped, dropped
        return new

    def __del__(self) -> None:
        if hasattr(self, "_free"):
            for slot in self._slots:
                self._free(ctypes.byref(slot))
