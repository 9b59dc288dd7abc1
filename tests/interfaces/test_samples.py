# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Batches of serialised messages, and the clock they are stamped with."""

from __future__ import annotations

import math
import struct

import pytest

from pdeloop.messages.frames import FrameError
from pdeloop.messages.samples import (
    ACTION_KIND,
    LIMIT,
    NO_TIME,
    STATE_KIND,
    ClockOffset,
    Sample,
    SampleBatch,
    TokenBucket,
    arrival_time,
    clock_message,
    unpack,
)


def bundled(*samples: Sample, sent: int = 99) -> bytes:
    batch = SampleBatch()
    for sample in samples:
        batch.add(sample.kind, sample.stamp, sample.raw, sample.time)
    return batch.take(sent)


def test_what_goes_in_comes_out_in_order():
    samples = [
        Sample(STATE_KIND, 7, b"state bytes"),
        Sample(STATE_KIND, 2**63, b"", 0.25),
        Sample(ACTION_KIND, 9, bytes(range(256))),
    ]
    sent, found = unpack(bundled(*samples, sent=12))
    assert sent == 12
    assert list(found) == samples


def test_a_bundle_is_an_ordinary_uint8_array():
    from rclpy.serialization import deserialize_message
    from std_msgs.msg import UInt8MultiArray

    raw = bundled(Sample(STATE_KIND, 7, b"abc"))
    message = deserialize_message(raw, UInt8MultiArray)
    assert message.layout.data_offset == 0 and not message.layout.dim
    assert bytes(message.data) == struct.pack("<QIIQd", 99, 0, 3, 7, -1.0) + b"abc"


def test_it_asks_to_be_sent_when_it_is_large_and_is_empty_afterwards():
    batch, count = SampleBatch(), 1
    while not batch.add(STATE_KIND, 0, bytes(1000), NO_TIME):
        count += 1
    assert LIMIT // 1024 <= count <= LIMIT // 1024 + 1
    batch.take(0)
    assert batch.size == 0
    assert list(unpack(batch.take(0))[1]) == []


@pytest.mark.parametrize(
    ("steps", "rate", "size", "least", "most"),
    [
        (100, 8000.0, 2048, 0.06, 0.09),  # a fast loop: about RATE of its samples
        (100, 500.0, 2048, 1.0, 1.0),  # a slow one: all of them
        (20_000, 8000.0, 2048, 0.45, 0.55),  # after a long episode not the next one
        (100, 4000.0, 131_072, 0.02, 0.04),  # large samples count as many
    ],
)
def test_people_get_whole_episodes_of_a_fast_loop_and_all_of_a_slow_one(
    steps, rate, size, least, most
):
    allowance, now, shown, episodes = TokenBucket(), 100.0, 0, 0
    longest_wait, since = 0.0, now
    while now < 160.0:
        episodes += 1
        admitted = allowance.admits(now)
        now += steps / rate
        if admitted:
            shown += 1
            longest_wait, since = max(longest_wait, now - steps / rate - since), now
            for _ in range(steps):
                allowance.use(size)
    assert least <= shown / episodes <= most
    assert longest_wait <= 1.0 + 1.1 * steps / rate


def test_every_truncation_is_refused():
    raw = bundled(Sample(STATE_KIND, 7, b"state"), Sample(ACTION_KIND, 8, b"action"))
    for length in range(len(raw)):
        with pytest.raises(FrameError):
            list(unpack(raw[:length])[1])


@pytest.mark.parametrize("position", [0, 1, 4, 8, 12])
def test_another_layout_is_refused(position: int):
    raw = bytearray(bundled(Sample(STATE_KIND, 7, b"state")))
    raw[position] ^= 0x40
    with pytest.raises(FrameError, match="layout"):
        unpack(bytes(raw))


def test_an_unknown_kind_and_a_length_beyond_the_end_are_refused():
    raw = bytearray(bundled(Sample(STATE_KIND, 7, b"state")))
    for offset, number in ((24, 2), (28, 2**32 - 1)):
        broken = bytearray(raw)
        struct.pack_into("<I", broken, offset, number)
        with pytest.raises(FrameError, match="neither a state nor an action"):
            list(unpack(bytes(broken))[1])


@pytest.mark.parametrize("seconds", [0.0, 0.05, 1.9999999996, 2.0**31 - 1])
def test_simulated_time_is_told_as_ros_does_it(seconds: float):
    from rclpy.serialization import deserialize_message
    from rosgraph_msgs.msg import Clock

    raw = clock_message(seconds)
    assert raw is not None
    told = deserialize_message(raw, Clock).clock
    assert told.sec + told.nanosec * 1e-9 == pytest.approx(seconds, abs=1e-9)


@pytest.mark.parametrize("seconds", [-1.0, 2.0**31, math.inf, math.nan])
def test_a_time_that_the_clock_cannot_tell_is_none(seconds: float):
    assert clock_message(seconds) is None


def test_stamps_are_put_on_the_readers_clock():
    clock = ClockOffset()
    day, second = 7_000, 10**9  # the sender's other clock is ahead by 7 us
    assert clock.update(1_000, day + 1_000, received=5_000) == 4_000
    assert clock.update(2_000, day + 2_000, received=9_000) == 4_000  # a batch that took longer
    assert clock.update(3_000, day + 3_000, received=6_500) == 3_500  # one that was faster
    assert clock.update(4_000, day + 4_000, received=second) == 3_500  # the reader was held up
    later = 3_600 * second
    assert clock.update(5_000, later, received=later + 2_000) == later - 3_000  # it was set
    assert clock.update(6_000, later + 1_000, received=later + 2_000) == later - 4_000


@pytest.mark.parametrize("stamp, offset", [(2**64 - 1, 0), (2**63, 0), (5, -6), (2**62, 2**62)])
def test_a_stamp_beyond_any_time_is_refused(stamp, offset):
    assert arrival_time(5, -5) == 0
    with pytest.raises(FrameError, match="expected a sample with a time"):
        arrival_time(stamp, offset)


def test_stamps_follow_a_clock_that_drifts():
    clock = ClockOffset()
    second = 10**9
    for sent in range(0, 100 * second, second):  # another host's, slow by 20 us a second
        drift = 20_000 * sent // second
        assert 0 <= drift - clock.update(sent, sent, received=sent + drift) <= 20 * 20_000
