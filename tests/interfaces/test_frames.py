# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The wire: our CDR bytes are those of ROS, and nothing but the interface is accepted."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from pdeloop.messages.frames import MAX_ID, ArrayCodec, Frame, FrameError
from pdeloop.messages.topics import ARRAYS


def message(labels: tuple[str, ...], frame: Frame) -> Float64MultiArray:
    """The frame as a ROS user would write it."""
    result = Float64MultiArray()
    shape = frame.values.shape
    for axis, (label, size) in enumerate(zip(labels, shape, strict=True)):
        stride = int(np.prod(shape[axis:]))
        result.layout.dim.append(MultiArrayDimension(label=label, size=size, stride=stride))
    result.layout.data_offset = 5
    head = [float(frame.run), float(frame.episode), float(frame.step), frame.time]
    head.append(float(frame.plant))
    result.data = head + frame.values.ravel().tolist()
    return result


def frame_of(shape: tuple[int, ...]) -> Frame:
    values = np.random.default_rng(0).standard_normal(shape)
    return Frame(run=MAX_ID - 1, episode=2**32 + 7, step=299, time=12.25, values=values, plant=31)


@pytest.mark.parametrize("topic", ARRAYS, ids=lambda topic: topic.name)
def test_our_bytes_are_read_by_ros_and_ros_bytes_by_us(topic):
    for size in (0, 1, 3, 128):
        frame = frame_of((size, 5, 7)[: len(topic.labels)])
        codec = ArrayCodec(topic.labels)
        expected = message(topic.labels, frame)
        assert deserialize_message(codec.encode(frame), Float64MultiArray) == expected
        for raw in (serialize_message(expected), codec.encode(frame), codec.encode(frame)):
            back = codec.decode(raw)
            assert (back.run, back.episode, back.step) == (frame.run, frame.episode, frame.step)
            assert (back.time, back.plant) == (frame.time, frame.plant)
            assert back.values.shape == frame.values.shape
            assert back.values.tobytes() == frame.values.tobytes()


def test_big_endian_bytes_are_read():
    little = ArrayCodec(("x",)).encode(Frame(1, 2, 3, 0.5, np.array([1.5, -2.5]), 9))
    label = struct.pack(">I", 2) + b"x\0" + b"\0\0"
    head = b"\0\0\0\0" + struct.pack(">I", 1) + label + struct.pack(">IIII", 2, 2, 5, 7)
    head += bytes(-(len(head) - 4) % 8)
    big = head + struct.pack(">7d", 1, 2, 3, 0.5, 9, 1.5, -2.5)
    assert len(big) == len(little)
    frame = ArrayCodec(("x",)).decode(big)
    assert (frame.run, frame.episode, frame.step, frame.time) == (1, 2, 3, 0.5)
    assert frame.values.tolist() == [1.5, -2.5]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda m: m.layout.dim.pop(), "axes"),
        (lambda m: setattr(m.layout.dim[0], "label", "row"), "labelled 'env'"),
        (lambda m: setattr(m.layout.dim[0], "size", 3), "strides|numbers"),
        (lambda m: setattr(m.layout.dim[1], "stride", 1), "strides"),
        (lambda m: setattr(m.layout.dim[0], "size", 2**31), "at most"),
        (lambda m: setattr(m.layout, "data_offset", 4), "data_offset"),
        (lambda m: m.data.append(1.0), "numbers"),
        (lambda m: m.data.__setitem__(3, float("nan")), "NaN"),
        (lambda m: m.data.__setitem__(6, float("nan")), "NaN"),
        (lambda m: m.data.__setitem__(6, float("inf")), "NaN or infinity"),
        (lambda m: m.data.__setitem__(0, -1.0), "run"),
        (lambda m: m.data.__setitem__(1, 0.5), "episode"),
        (lambda m: m.data.__setitem__(2, 2.0**53), "step"),
        (lambda m: m.data.__setitem__(4, -7.0), "plant"),
    ],
)
def test_what_is_not_the_interface_is_refused(change, expected):
    labels = ("env", "x")
    bad = message(labels, frame_of((2, 4)))
    change(bad)
    with pytest.raises(FrameError, match=expected):
        ArrayCodec(labels).decode(serialize_message(bad))


@pytest.mark.parametrize("known", [False, True], ids=["first", "like the one before"])
def test_what_follows_the_numbers_is_padding_to_4_bytes_or_refused(known):
    codec = ArrayCodec(("env", "x"))
    raw = codec.encode(frame_of((2, 4)))
    for more in range(12):
        if known:
            codec.decode(raw)
        if more < 4:
            assert codec.decode(raw + bytes(more)).values.shape == (2, 4)
        else:
            with pytest.raises(FrameError, match="got another length"):
                codec.decode(raw + bytes(more))


def test_messages_of_ever_other_shapes_leave_little_behind():
    codec = ArrayCodec(("env", "actuator"))
    for rows in range(2_000_000, 2_000_020):
        codec.encode(frame_of((rows, 1)))
    kept = sum(len(buffer) for buffer, _, _ in codec._templates.values())
    assert kept < 3 * 8 * 2_000_020
