# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Bags of each kind in the readers of others: the same messages, in the order of their times."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.serialization import deserialize_message
from rosbags.highlevel import AnyReader
from std_msgs.msg import Float64MultiArray

from pdeloop.bags.reader import Bag
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import ACTION, COST, START, STATE
from recorder_node.recording import ARRAY_TYPE, CLOCK, Recording, sources
from tests.support.converted import convert
from tests.support.written_bag import RUN, SECOND, encode, frame

Row = tuple[int, str, tuple[tuple[str, int, int], ...], bytes]
"""Log time, topic, the dimensions of the layout, the bits of the numbers."""
MILLISECOND = 10**6


def few_sensors(folder: Path) -> Path:
    """Two environments with three measurements each."""
    return recorded(folder, ["/left"], lambda step: frame(step, 2, 3))


def two_pairs(folder: Path) -> Path:
    """Two namespaces whose messages have the same times."""
    return recorded(folder, ["/left", "/right"], lambda step: frame(step, 1, 16))


def empty_arrays(folder: Path) -> Path:
    """A stand-in's, with states of no environment, of no value, and none of both."""
    shapes = ((1, 5), (0, 5), (1, 0), (0, 0))
    return recorded(folder, ["/left"], lambda step: frame(step, *shapes[step]))


def recorded(folder: Path, pairs: list[str], state: Callable[[int], Frame]) -> Path:
    """An episode of four states and actions of each pair, which are recorded in turn."""
    recording = Recording(folder / "bag", [*(s for pair in pairs for s in sources(pair)), CLOCK])
    recording.take(CLOCK, SECOND, bytes.fromhex("00010000") + bytes(8))
    contents = [(START, Frame(RUN, 7, 0, 0.0, np.array([(3.0, 4.0, 0.1, 0.0)])))]
    for step in range(4):
        contents += [(STATE, state(step)), (ACTION, frame(step, 1, 4))]
    contents.append((COST, Frame(RUN, 7, 3, 0.0, np.array([(1.0, 3.0, -1.0)]), 99)))
    for number, (topic, content) in enumerate(contents):
        for pair in pairs:
            (source,) = (s for s in sources(pair) if s.array == topic)
            recording.take(source, 2 * SECOND + number * MILLISECOND, encode(topic, content))
    recording.note(RUN, {"n_z": 16})
    recording.close()
    return folder / "bag"


def row(time: int, topic: str, message: Any) -> Row:
    dims = tuple((d.label, d.size, d.stride) for d in message.layout.dim)
    return time, topic, dims, np.asarray(message.data, dtype=np.float64).tobytes()


def by_ours(bag: Path) -> list[Row]:
    """The messages of our reader, in ROS's own deserialisation."""
    return [
        row(m.when, m.topic, deserialize_message(m.data, Float64MultiArray))
        for m in Bag(bag).messages()
        if m.type == ARRAY_TYPE
    ]


def by_mcap(bag: Path) -> list[Row]:
    with (bag / f"{bag.name}.mcap").open("rb") as file:
        decoded = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        return [
            row(message.log_time, channel.topic, content)
            for schema, channel, message, content in decoded
            if schema is not None and schema.name == ARRAY_TYPE
        ]


def by_rosbags(bag: Path) -> list[Row]:
    with AnyReader([bag]) as reader:
        return [
            row(time, connection.topic, reader.deserialize(data, connection.msgtype))
            for connection, time, data in reader.messages()
            if connection.msgtype == ARRAY_TYPE
        ]


def agree(bag: Path, *readers: Callable[[Path], list[Row]]) -> list[Row]:
    """What all readers find in it, which is in the order of time."""
    ours = by_ours(bag)
    assert [time for time, *_ in ours] == sorted(time for time, *_ in ours)
    for read in readers:
        assert read(bag) == ours, read.__name__
    return ours


@pytest.fixture(params=["training", "few sensors", "two pairs", "empty arrays"])
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """One bag of each kind."""
    if request.param == "training":
        run: Path = request.getfixturevalue("run")
        return run / "bag"
    kinds = {"few sensors": few_sensors, "two pairs": two_pairs, "empty arrays": empty_arrays}
    return kinds[request.param](tmp_path)


def test_others_read_the_same_numbers_in_the_same_order(bag: Path, tmp_path: Path) -> None:
    ours = agree(bag, by_mcap, by_rosbags)
    assert {topic.split("/")[-1] for _, topic, *_ in ours} >= {"state", "action", "cost", "start"}
    there, back = tmp_path / "there", tmp_path / "back"
    convert("rosbags-convert", "--src", str(bag), "--dst", str(there), "--dst-storage", "sqlite3")
    convert("rosbags-convert", "--src", str(there), "--dst", str(back), "--dst-storage", "mcap")
    assert by_rosbags(there) == agree(back, by_mcap, by_rosbags) == ours


def test_two_pairs_are_both_there(tmp_path: Path) -> None:
    ours = agree(two_pairs(tmp_path), by_mcap, by_rosbags)
    for pair in ("/left", "/right"):
        assert sum(topic.startswith(f"{pair}/") for _, topic, *_ in ours) == 10


def test_an_empty_array_has_its_shape_in_every_reader(tmp_path: Path) -> None:
    ours = agree(empty_arrays(tmp_path), by_mcap, by_rosbags)
    states = [dims for _, topic, dims, _ in ours if topic == "/left/state"]
    assert [[size for _, size, _ in dims] for dims in states] == [[1, 5], [0, 5], [1, 0], [0, 0]]
