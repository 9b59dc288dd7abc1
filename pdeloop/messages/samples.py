# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Many serialised messages in one, published by the plant for recorders and viewers.

A reader of its own for every state and action would cost the loop a packet and a wake-up per sample
and reader. Instead the plant keeps the bytes of the states it sends and of the actions it receives,
and publishes them together, some hundred at a time, on the topic `samples`
(std_msgs/UInt8MultiArray, data_offset 0, no dims). Its data are, little-endian,

    sent                                     uint64, ns on the plant's monotonic clock
    kind, length, stamp, time, bytes, ...    uint32, uint32, uint64 (ns, the same clock), float64,
                                             `length` bytes

repeated; kind 0 is a state, 1 an action, and bytes are the message as it was on its own topic. time
is the simulated time in s that the plant publishes on /clock with a state, with or without a
subscriber; NO_TIME for an action and for a plant without /clock.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pdeloop.messages.frames import FrameError

STATE_KIND, ACTION_KIND = 0, 1
CLOCK_KIND = 2
"""Kind of the message on /clock that accompanies a state, for readers of samples; not in a batch."""
LIMIT = 512 * 1024
"""Bytes after which a batch is sent: a few milliseconds of a fast loop."""
NO_TIME = -1.0
"""The time stamp of a sample without simulated time."""
AGE = 0.1
"""Seconds after which a batch is sent even if it has not reached LIMIT."""
MAX_TIME = 2.0**31
"""Simulated time in s up to which /clock, whose seconds are an int32, can tell it."""
RATE, COUNTED = 600.0, 4096
"""Samples per second that viewers get, of up to this many bytes."""

_MESSAGE = struct.Struct("<4sIIIQ")
"""CDR of an UInt8MultiArray without dims up to its data, and the first eight bytes of those."""
_ENCODING = b"\x00\x01\x00\x00"
_SAMPLE = struct.Struct("<IIQd")
SAMPLE_HEADER = _SAMPLE.size
"""Bytes in front of a sample's own."""
_CLOCK = struct.Struct("<BBHiI")
"""CDR of a rosgraph_msgs/Clock."""
_STEP = 100_000_000
"""Nanoseconds by which the sender's two clocks may part before one of them was set, or is another."""
_WINDOW = 10_000_000_000
"""Nanoseconds of which the smallest delay counts: clocks of two hosts drift apart."""


class TokenBucket:
    """Selects the episodes for viewers: whole ones, about RATE samples a second.

    A sample of at most COUNTED bytes takes one token, a larger one more; RATE tokens come back a
    second. An episode may take more than there are: the next ones are then left out, for a second at
    most. In a loop that is slower than RATE none is.
    """

    def __init__(self) -> None:
        self._tokens, self._when = 0.0, -math.inf

    def admits(self, now: float) -> bool:
        """True if the episode that begins now (monotonic s) must be shown."""
        self._tokens = max(-RATE, min(RATE, self._tokens + RATE * (now - self._when)))
        self._when = now
        return self._tokens >= 0.0

    def use(self, size: int, count: int = 1) -> None:
        """Samples of `size` bytes were shown."""
        self._tokens -= count * max(1.0, size / COUNTED)


class SampleBatch:
    """Collects samples, one behind the other, as they will be sent."""

    def __init__(self) -> None:
        self._memory = bytearray(_MESSAGE.size)
        self.size = 0

    def add(self, kind: int, stamp: int, raw: bytes, time: float) -> bool:
        """Add a serialised message; whether the batch should be sent now."""
        at = _MESSAGE.size + self.size
        self._make_room(SAMPLE_HEADER + len(raw))
        _SAMPLE.pack_into(self._memory, at, kind, len(raw), stamp, time)
        self._memory[at + SAMPLE_HEADER : at + SAMPLE_HEADER + len(raw)] = raw
        self.size += SAMPLE_HEADER + len(raw)
        return self.size >= LIMIT

    def reserve(self, record: np.void, room: int) -> None:
        """Let compiled code append, at most `room` bytes beyond the limit, until `commit`."""
        self._make_room(max(LIMIT - self.size, 0) + room)
        begin = np.frombuffer(self._memory, np.uint8).ctypes.data + _MESSAGE.size
        record["end"], record["limit"] = begin + self.size, begin + LIMIT

    def commit(self, record: np.void) -> bool:
        """Compiled code is done; whether the batch should be sent now."""
        self.size = int(record["end"] - record["limit"]) + LIMIT
        return self.size >= LIMIT

    def take(self, sent: int) -> bytes:
        """CDR bytes of the message that holds them all; the batch is empty afterwards."""
        _MESSAGE.pack_into(self._memory, 0, _ENCODING, 0, 0, 8 + self.size, sent)
        end, self.size = _MESSAGE.size + self.size, 0
        return bytes(memoryview(self._memory)[:end])

    def _make_room(self, more: int) -> None:
        lacking = _MESSAGE.size + self.size + more - len(self._memory)
        if lacking > 0:
            self._memory += bytes(lacking + len(self._memory) // 2)


@dataclass(frozen=True, slots=True)
class Sample:
    """A message of the batch: its kind, ns on the plant's clock, its CDR bytes, simulated time."""

    kind: int
    stamp: int
    raw: bytes
    time: float = NO_TIME


def unpack(message: bytes) -> tuple[int, Iterator[Sample]]:
    """The time the batch was sent (ns on the plant's clock) and its samples.

    Raises FrameError, also while the samples are read, for bytes that are not a batch.
    """
    if len(message) < _MESSAGE.size:
        raise FrameError(f"expected a batch of samples, got {len(message)} bytes")
    encoding, dims, offset, count, sent = _MESSAGE.unpack_from(message)
    end = _MESSAGE.size - 8 + count
    # RTPS rounds a payload up to four bytes.
    if encoding != _ENCODING or dims or offset or not 0 <= len(message) - end < 4 or count < 8:
        raise FrameError("expected a batch of samples, got another layout")
    return sent, _samples(message, end)


def _samples(message: bytes, end: int) -> Iterator[Sample]:
    position = _MESSAGE.size
    while position < end:
        start = position + _SAMPLE.size
        if start > end:
            raise FrameError("a batch of samples ends within a sample")
        kind, length, stamp, time = _SAMPLE.unpack_from(message, position)
        position = start + length
        if kind > ACTION_KIND or position > end:
            raise FrameError(
                "a batch of samples holds something that is neither a state nor an action"
            )
        yield Sample(kind, stamp, message[start:position], time)


def clock_message(time: float) -> bytes | None:
    """CDR bytes of a message on /clock with a simulated time in s; None if it has no such time."""
    if not 0.0 <= time < MAX_TIME:
        return None
    return _CLOCK.pack(0, 1, 0, *divmod(round(time * 1e9), 10**9))


def arrival_time(stamp: int, offset: int) -> int:
    """Arrival time of a sample, in ns since the epoch. FrameError beyond what ROS's time can hold.

    offset: see ClockOffset.
    """
    if not 0 <= stamp + offset < 2**63:
        raise FrameError(f"expected a sample with a time, got the stamp {stamp} ns")
    return stamp + offset


class ClockOffset:
    """Puts the plant's stamps on the reader's clock: the smallest delay of late counts as none.

    So the times of samples do not depend on how many came together, nor on the clocks of hosts, nor
    on how long the reader was delayed.
    """

    def __init__(self) -> None:
        self._smallest: list[int] = []
        """In the window before, and in this one."""
        self._began = self._clocks = 0

    def update(self, sent: int, source: int, received: int) -> int:
        """The offset in ns to add to a stamp, after a batch.

        sent: when, on the clock of the stamps; source: the same on the sender's clock of day, as the
        middleware tells it; received: when, on the reader's.
        """
        offset, clocks = received - sent, source - sent
        if not self._smallest or abs(clocks - self._clocks) > _STEP:
            self._smallest, self._began = [offset, offset], received
        elif received - self._began > _WINDOW:
            self._smallest, self._began = [self._smallest[1], offset], received
        self._clocks = clocks
        self._smallest[1] = min(self._smallest[1], offset)
        return min(self._smallest)
