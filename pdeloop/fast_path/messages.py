# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Serialised messages of the loop inside compiled functions (see `frames` for their format).

Within an episode a peer sends the same prefix and the same run, episode and plant in every message.
They are compared with the bytes and numbers that are expected. Whatever differs is left to
`frames.ArrayCodec`.
"""

import math
import struct
from typing import Any

import numpy as np

from pdeloop.jit.cache import jit
from pdeloop.jit.simd import (
    WIDTH,
    lane_sum,
    load,
    load_lanes_unaligned,
    load_unaligned,
    load_word_unaligned,
    read,
    splat,
    store_lanes_unaligned,
    store_unaligned,
    store_word_unaligned,
)
from pdeloop.messages.frames import HEADER, ArrayCodec, Frame
from pdeloop.messages.samples import SAMPLE_HEADER

RUN, EPISODE, STEP, TIME, PLANT, FIRST = range(HEADER + 1)
"""Places of the numbers of the header, and of the first value behind it."""
EXPECTED = np.dtype(
    [
        ("prefix", np.int64),  # address of the bytes in front of the header
        ("start", np.int64),  # how many they are
        ("values", np.int64),  # how many numbers follow the header
        ("run", np.float64),
        ("episode", np.float64),
        ("plant", np.float64),
    ]
)


@jit
def expected_header(raw: int, length: int, expected: Any) -> int:
    """Address of the header of a message of the expected kind, all of it finite; 0 of any other.

    raw, length: where the message is.
    """
    start, values = expected.start, expected.values
    if length != start + 8 * (FIRST + values):
        return 0
    for at in range(0, start - 7, 8):
        if load_word_unaligned(raw + at, 0) != load_word_unaligned(expected.prefix + at, 0):
            return 0
    if load_word_unaligned(raw + start - 8, 0) != load_word_unaligned(
        expected.prefix + start - 8, 0
    ):
        return 0
    head = raw + start
    if (
        load_unaligned(head, RUN) != expected.run
        or load_unaligned(head, EPISODE) != expected.episode
    ):
        return 0
    if load_unaligned(head, PLANT) != expected.plant:
        return 0
    step, time = load_unaligned(head, STEP), load_unaligned(head, TIME)
    # x - x is 0, and NaN if x is NaN or infinite.
    lanes, last = splat(0.0), values % WIDTH
    for i in range(0, values - last, WIDTH):
        x = load_lanes_unaligned(head, FIRST + i)
        lanes = lanes + (x - x)
    total = lane_sum(lanes) + (step - step) + (time - time)
    for i in range(values - last, values):
        total += load_unaligned(head, FIRST + i) - load_unaligned(head, FIRST + i)
    return head if total == 0.0 else 0


SAMPLE_BATCH = np.dtype(
    [
        ("end", np.int64),  # address behind the last sample
        ("limit", np.int64),  # the address from which on the batch should be sent
        ("open", np.int64),  # whether it takes samples
    ]
)
"""A batch (samples.SampleBatch) inside compiled functions."""


@jit
def append(batch: Any, kind: int, stamp: int, time: float, raw: int, length: int) -> None:
    """Add the serialised message at an address, if the batch is open; there must be room."""
    if not batch.open:
        return
    at = batch.end
    store_word_unaligned(at, 0, kind | (length << 32))
    store_word_unaligned(at, 1, stamp)
    store_unaligned(at, 2, time)
    at += SAMPLE_HEADER
    whole = length // 8
    for i in range(whole):
        store_word_unaligned(at, i, load_word_unaligned(raw, i))
    if length > 8 * whole:  # bytes up to the last one, some of them again
        store_word_unaligned(at + length - 8, 0, load_word_unaligned(raw + length - 8, 0))
    batch.end = at + length


@jit
def full(batch: Any) -> bool:
    """True if the batch should be sent."""
    return bool(batch.open and batch.end >= batch.limit)


class OwnMessage:
    """A message in memory of its own, to be filled in by compiled code and sent again and again.

    raw: its bytes; begin: their address; header: address of its header; shape: of its values.
    """

    def __init__(self, codec: ArrayCodec, frame: Frame) -> None:
        self.raw = bytearray(codec.encode(frame))
        self._start = len(self.raw) - 8 * (HEADER + math.prod(frame.values.shape))
        self._held = np.frombuffer(self.raw, np.uint8)
        self.begin = self._held.ctypes.data
        self.header = self.begin + self._start
        self.shape = frame.values.shape

    def address_to(self, frame: Frame) -> None:
        """Take over run, episode and plant."""
        struct.pack_into("<2d", self.raw, self._start, frame.run, frame.episode)
        struct.pack_into("<d", self.raw, self._start + 8 * PLANT, frame.plant)


@jit
def write_answer(head: int, step: int, time: float, values: int, count: int) -> None:
    """Fill in step, time and values (an array at an address) of one of our messages."""
    store_unaligned(head, STEP, step)
    store_unaligned(head, TIME, time)
    last = count % WIDTH
    for i in range(0, count - last, WIDTH):
        store_lanes_unaligned(head, FIRST + i, load(values, i))
    for i in range(count - last, count):
        store_unaligned(head, FIRST + i, read(values, i))
