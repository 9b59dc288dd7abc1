# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Bags: written from serialised bytes, read back by independent libraries, safe against what breaks."""

from __future__ import annotations

import json
import os
import re
import shutil
import sqlite3
import struct
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, Header, McapRecord, Schema
from mcap.writer import MCAP0_MAGIC as MAGIC
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

from loop_interfaces.episodes import episode_name, episode_number
from loop_interfaces.frames import Frame
from loop_interfaces.spec import ParameterError
from loop_interfaces.topics import ACTION, COST, START, STATE
from pdeloop.bags.episodes import EpisodeIndex, RecordedEpisode
from pdeloop.bags.info import describe, info_text
from pdeloop.bags.reader import Bag, bags_of
from pdeloop.bags.recorded_run import RecordedRun
from pdeloop.bags.verify import verify
from pdeloop.cli import main
from pdeloop.identification import identify_bag
from recorder_node import bag as bag_module
from recorder_node.bag import BagError, definition
from recorder_node.recording import Recording
from recorder_node.sources import CLOCK, DIAGNOSTICS, ROSOUT, Source, sources
from tests.support.interpreter import python
from tests.support.small_disk import read_only_folder, small_disk

RUN = 2**52 + 1
SECOND = 10**9
MESSAGES = 1 + 2 * (1 + 6 + 6 + 1) + 1
"""Of the bag `written`: a time, two episodes, the parameters of the run."""
WHAT = [*sources("/left"), CLOCK]
BY_TOPIC = {source.array: source for source in WHAT if source.array}


def frame(step: int, *shape: int, episode: int = 7) -> Frame:
    values = np.random.default_rng([step, *shape]).standard_normal(shape)
    return Frame(RUN, episode, step, 0.25 * step, values, 99)


def encode(topic, content: Frame) -> bytes:
    return topic.codec().encode(content)


def recorded_episode(
    recording: Recording,
    episode: int = 7,
    steps: int = 5,
    skip: int = -1,
    cost: Mapping[str, Any] = {},
) -> None:
    """An episode as the loop would send it, a message a millisecond."""
    when = episode * SECOND

    def take(topic, content: Frame) -> None:
        nonlocal when
        when += SECOND // 1000
        recording.take(BY_TOPIC[topic], when, encode(topic, content))

    rows = np.array([(3.0, 4.0, 0.1, 0.0)])
    take(START, Frame(RUN, episode, 0, 0.0, rows))
    for step in range(steps + 1):
        if step != skip:
            take(STATE, frame(step, 1, 16, episode=episode))
        take(ACTION, frame(step, 1, 4, episode=episode))
    usual = Frame(RUN, episode, steps, 0.0, np.array([(1.0, 5.0, -1.0)]), 99)
    take(COST, replace(usual, **cost))


def written(folder: Path, **how: int) -> Path:
    path = folder / "bag"
    recording = Recording(path, WHAT)
    recording.take(WHAT[-1], SECOND, bytes.fromhex("00010000") + bytes(8))
    for episode in (7, 8):
        recorded_episode(recording, episode, **how)
    recording.note(RUN, {"n_z": 16})
    recording.close()
    return path


def killed(bag: Path) -> Path:
    """What a recorder that is killed now leaves behind."""
    copy = bag.with_name("killed")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(bag, copy)
    return copy


def test_rosbags_reads_what_was_written_with_its_definitions(tmp_path):
    path = written(tmp_path)
    with AnyReader([path]) as reader:
        assert reader.message_count == MESSAGES
        states = [c for c in reader.connections if c.topic == "/left/state"]
        for connection, _, raw in reader.messages(states):
            message = reader.deserialize(raw, connection.msgtype)
            sent = frame(int(message.data[2]), 1, 16, episode=int(message.data[1]))
            assert np.array_equal(message.data[5:], sent.values.ravel())
            assert [d.label for d in message.layout.dim] == ["env", "x"]
        (clocks,) = [c for c in reader.connections if c.topic == "/clock"]
        (raw,) = [raw for _, _, raw in reader.messages([clocks])]
        assert reader.deserialize(raw, clocks.msgtype).clock.sec == 0


def test_mcap_reads_what_was_written_with_its_definitions(tmp_path):
    path = written(tmp_path)
    with (path / "bag.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics.message_count == MESSAGES
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        seen = 0
        for _, channel, _, message in reader.iter_decoded_messages(topics="/left/state"):
            sent = frame(int(message.data[2]), 1, 16, episode=int(message.data[1]))
            assert list(message.data[5:]) == sent.values.ravel().tolist()
            assert channel.topic == "/left/state"
            seen += 1
        assert seen == 12


def test_metadata_tells_of_every_topic_what_rosbag2_tells(tmp_path):
    path = written(tmp_path)
    content = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (content["version"], content["storage_identifier"]) == (9, "mcap")
    assert (content["message_count"], content["relative_file_paths"]) == (MESSAGES, ["bag.mcap"])
    known = {
        t["topic_metadata"]["name"]: t["topic_metadata"]
        for t in content["topics_with_message_count"]
    }
    # As `ros2 topic info --verbose` of ROS 2 Jazzy prints them.
    hashes = {
        "/left/model/failed": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
        "/left/state": "1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f",
        "/clock": "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564",
    }
    with (path / "bag.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    channels = {channel.topic: channel for channel in summary.channels.values()}
    with AnyReader([path]) as reader:
        for connection in reader.connections:
            assert connection.digest == known[connection.topic]["type_description_hash"]
            assert channels[connection.topic].metadata["topic_type_hash"] == connection.digest
            (offered,) = connection.ext.offered_qos_profiles
            durable = offered.durability is QosDurability.TRANSIENT_LOCAL
            assert durable == (connection.topic not in ("/left/state", "/left/action", "/clock"))
    for topic, digest in hashes.items():
        assert known[topic]["type_description_hash"] == f"RIHS01_{digest}"


def test_the_first_and_the_last_message_are_told_also_when_they_came_in_another_order(tmp_path):
    recording = Recording(tmp_path / "bag", WHAT)
    for when in (5, 9, 3, 7):
        recording.take(BY_TOPIC[STATE], when * SECOND, encode(STATE, frame(when, 1, 16)))
    recording.close()
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    content = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert content["starting_time"]["nanoseconds_since_epoch"] == 3 * SECOND
    assert content["duration"]["nanoseconds"] == 6 * SECOND


def test_bags_and_their_files_are_read_in_the_order_of_their_numbers(tmp_path):
    for number in (1, 2, 10):
        name = "bag" if number == 1 else f"bag-{number}"
        recording = Recording(tmp_path / "run" / name, WHAT)
        recorded_episode(recording, number)
        recording.close()
    bags = bags_of(tmp_path / "run")
    assert [next(iter(bag.episodes())).number for bag in bags] == [1, 2, 10]
    (tmp_path / "split").mkdir()
    for number, bag in zip((1, 2, 10), bags, strict=True):
        (bag.path / "bag.mcap").rename(tmp_path / "split" / f"split_{number}.mcap")
    when = [message.when for message in Bag(tmp_path / "split").messages()]
    assert when == sorted(when)


@pytest.mark.parametrize("source", [*WHAT, DIAGNOSTICS, ROSOUT], ids=lambda s: s.channel.topic)
def test_the_hash_of_a_type_is_that_of_the_installed_ros(source):
    package, _, kind = source.channel.type.partition("/msg/")
    (installed,) = Path(sys.prefix).glob(f"share/{package}/msg/{kind}.json")
    hashes = json.loads(installed.read_text())["type_hashes"]
    assert {
        "type_name": source.channel.type,
        "hash_string": definition(source.channel.type)[1],
    } in hashes


def test_an_episode_is_found_by_its_number(tmp_path):
    bag = Bag(written(tmp_path))
    assert [(e.number, e.missing) for e in bag.episodes()] == [(7, []), (8, [])]
    (found,) = (episode for episode in bag.episodes() if episode.number == 8)
    assert found.missing == []
    states, actions = found.trajectory()
    assert states.shape == (6, 1, 16) and actions.shape == (5, 1, 4)
    assert np.array_equal(states[3], frame(3, 1, 16, episode=8).values)
    assert bag.parameters() == {RUN: {"n_z": 16}}


def test_people_read_the_start_of_the_tuner_and_the_number_of_the_episode_since():
    for number, name in ((7, "7"), (2**32 + 7, "1.7"), (3 * 2**32 + 10, "3.10")):
        assert episode_name(number) == name
        assert episode_number(name) == episode_number(str(number)) == number
    with pytest.raises(ValueError, match="invalid literal"):
        episode_number("1.7.2")


def test_the_episodes_are_listed_with_their_costs_and_what_they_lack(tmp_path):
    *_, head, first, second = info_text(describe(written(tmp_path, skip=3))).splitlines()
    assert head.split() == ["episode", "environments", "seconds", "mean", "stage", "cost"]
    assert first.split() == [
        "7",
        "1",
        "0.01",
        "1",
        "exploratory,",
        "lacks",
        "1",
        "of",
        "6",
        "states",
    ]
    assert second.split()[0] == "8"


def test_a_lost_sample_makes_the_episode_incomplete(tmp_path):
    bag = Bag(written(tmp_path, skip=2))
    assert [episode.missing for episode in bag.episodes()] == [["1 of 6 states"]] * 2


def test_what_was_flushed_is_readable_without_an_end(tmp_path):
    path = tmp_path / "bag"
    recording = Recording(path, WHAT)
    recorded_episode(recording, 7)
    recording.flush()
    recorded_episode(recording, 8)  # never flushed: as if killed now
    path = killed(path)
    recording.close()
    bag = Bag(path)
    assert not bag.finished
    assert [episode.number for episode in bag.episodes()] == [7]
    assert len(list(bag.messages())) == 14


def test_of_a_batch_all_survives_or_nothing(tmp_path):
    recording = Recording(tmp_path / "bag", WHAT)
    raw = encode(STATE, frame(0, 8, 1024))  # 64 kB

    def survivors() -> int:
        return sum(1 for _ in Bag(killed(tmp_path / "bag")).messages())

    for batch in range(3):
        for when in range(40):
            recording.take(BY_TOPIC[STATE], SECOND + 40 * batch + when, raw)
            assert survivors() % 40 == 0
        recording.pause()
        assert survivors() % 40 == 0
    recording.flush()
    assert survivors() == 3 * 40
    recording.close()


@pytest.mark.parametrize("cut", [1, 50, 333])
def test_a_file_that_ends_within_a_record_is_read_up_to_there(tmp_path, cut):
    path = tmp_path / "bag"
    recording = Recording(path, WHAT)
    for episode in (7, 8):
        recorded_episode(recording, episode)
        whole = (path / "bag.mcap").stat().st_size
        recording.flush()
    file = killed(path) / "bag.mcap"
    recording.close()
    os.truncate(file, whole + cut)
    assert next(Bag(file.parent).episodes()).number == 7


def test_an_existing_bag_is_not_touched(tmp_path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(BagError, match="already exists; choose another folder"):
        Recording(tmp_path / "bag", WHAT)
    assert list((tmp_path / "bag").iterdir()) == []


def test_a_folder_that_cannot_be_written_is_a_clear_error(tmp_path):
    with (
        read_only_folder(tmp_path / "locked") as folder,
        pytest.raises(BagError, match=r"cannot write a bag to .*(Read-only|Permission)"),
    ):
        Recording(folder / "bag", WHAT)


def test_a_full_disk_stops_the_recording_and_keeps_what_was_written(tmp_path):
    with small_disk(tmp_path / "disk", megabytes=1) as disk:
        recording = Recording(disk / "bag", WHAT)

        def fill() -> None:
            for episode in range(1000):
                recorded_episode(recording, episode, steps=50)
                recording.flush()

        with pytest.raises(BagError, match=r"No space left.*; recording stopped"):
            fill()
        episodes = [e for e in Bag(disk / "bag").episodes() if not e.missing]
        assert len(episodes) > 5
        assert len(list(Bag(disk / "bag").messages())) >= len(episodes) * 104


def test_of_a_batch_that_the_disk_refuses_half_way_nothing_is_left(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_module, "LARGEST", 10_000)
    recording = Recording(tmp_path / "bag", WHAT)
    recorded_episode(recording, 7)
    recording.flush()
    size = (tmp_path / "bag" / "bag.mcap").stat().st_size
    file = recording._file._file

    class Full:
        """A file on a disk that is full after half of a batch."""

        room = 500

        def __getattr__(self, name: str) -> Any:
            return getattr(file, name)

        def write(self, data: Any) -> int:
            if not self.room:
                raise OSError(28, "No space left on device")
            written, self.room = int(file.write(data[: self.room])), 0
            return written

    monkeypatch.setattr(recording._file, "_file", Full())
    with pytest.raises(BagError, match=r"No space left on device; recording stopped"):
        for episode in range(8, 20):
            recorded_episode(recording, episode, steps=30)
    assert (tmp_path / "bag" / "bag.mcap").stat().st_size == size


def test_what_is_no_bag_is_a_clear_error(tmp_path):
    for path, words in (
        (tmp_path / "none", "no bag at"),
        (tmp_path, "there is no .mcap file"),
    ):
        with pytest.raises(BagError, match=words):
            Bag(path)
    run = tmp_path / "run"
    run.mkdir()
    (run / "parameters.yaml").write_text("")
    with pytest.raises(BagError, match="is a run without a bag; pdeloop train --record"):
        Bag(run)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: [1")
    (tmp_path / "x.mcap").write_bytes(b"nonsense")
    with pytest.raises(
        BagError, match="cannot be read, it is damaged: it is empty or not an MCAP file"
    ):
        list(Bag(tmp_path).messages())


def test_bags_of_another_storage_are_refused_with_what_converts_them(tmp_path):
    sqlite = tmp_path / "old"
    sqlite.mkdir()
    with sqlite3.connect(sqlite / "old.db3") as connection:
        connection.execute("CREATE TABLE messages (id INTEGER)")
    connection.close()
    with pytest.raises(BagError, match=r"is a sqlite3 bag; expected MCAP .*rosbags-convert --src"):
        Bag(sqlite)
    whole = tmp_path / "whole"
    whole.mkdir()
    (whole / "a.mcap.zstd").touch()
    with pytest.raises(BagError, match="is compressed by rosbag2; expected MCAP"):
        Bag(whole)
    single = written(tmp_path)
    text = (single / "metadata.yaml").read_text()
    (single / "metadata.yaml").write_text(
        text.replace("compression_mode: ''", "compression_mode: MESSAGE")
    )
    with pytest.raises(BagError, match="is compressed by rosbag2; expected MCAP"):
        Bag(single)


def test_what_rosbags_convert_makes_of_a_sqlite3_bag_is_read(tmp_path):
    """The command that the refusal names."""
    source, converted = tmp_path / "sqlite", tmp_path / "sqlite-mcap"
    convert = ("-m", "rosbags.convert")
    python(*convert, "--src", written(tmp_path), "--dst", source, "--dst-storage", "sqlite3")
    with pytest.raises(BagError, match="sqlite3") as refused:
        Bag(source)
    words = str(refused.value).split("Convert it: ")[1].split()
    assert words[0] == "rosbags-convert"
    python(*convert, *words[1:])
    assert [e.missing for e in Bag(converted).episodes()] == [[], []]


@pytest.mark.parametrize("finished", [False, True])
def test_bags_of_other_writers_are_read(tmp_path, finished):
    """As rosbag2 writes them: topics declared within chunks; lz4, or messages outside chunks."""
    original = list(Bag(written(tmp_path)).messages())
    for number, how in enumerate(
        (
            {"compression": CompressionType.LZ4},
            {"compression": CompressionType.NONE},
            {"use_chunking": False},
        )
    ):
        folder = tmp_path / str(number)
        folder.mkdir()
        with (folder / "x.mcap").open("wb") as file:
            writer = Writer(file, chunk_size=1000, **how)
            writer.start("ros2")
            schema = writer.register_schema("a/msg/B", "ros2msg", b"float64 c")
            channels = {
                topic: writer.register_channel(topic, "cdr", schema)
                for topic in {message.topic for message in original}
            }
            for message in original:
                writer.add_message(
                    channels[message.topic], message.when, message.data, message.when
                )
            writer.finish() if finished else writer.flush()
        again = list(Bag(folder).messages())
        assert [(m.topic, m.when, m.data) for m in again] == [
            (m.topic, m.when, m.data) for m in original
        ]


def record_bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def chunk(content: bytes, size: int) -> Chunk:
    return Chunk(
        compression="zstd",
        data=content,
        message_start_time=1,
        message_end_time=2,
        uncompressed_crc=0,
        uncompressed_size=size,
    )


def crafted(folder: Path, *records: bytes) -> Path:
    """A bag of these records."""
    folder.mkdir()
    header = record_bytes(Header("ros2", ""))
    (folder / "x.mcap").write_bytes(MAGIC + header + b"".join(records) + MAGIC)
    return folder


def zeros() -> bytes:
    """2 GiB of them, compressed."""
    compressor = zstandard.ZstdCompressor(level=1).compressobj()
    parts = [compressor.compress(bytes(2**24)) for _ in range(128)]
    return b"".join(parts) + compressor.flush()


MEMORY = """
import resource, sys
from pdeloop.cli import main
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for bag in sys.argv[1:]:
    for command in (("bag", "info"), ("bag", "verify"), ("identify", "--bag")):
        assert main([*command, bag]) == 1
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def test_a_small_file_that_becomes_gigabytes_is_refused_in_one_sentence(tmp_path):
    """Both kinds of file: one that says how large it becomes, and one that does not."""
    content = zeros()
    told = [
        crafted(tmp_path / str(size), record_bytes(chunk(content, size))) for size in (2**31, 1000)
    ]
    assert all((bag / "x.mcap").stat().st_size < 2**20 for bag in told)
    ended = python("-c", MEMORY, *told)
    lines = ended.stderr.splitlines()
    assert len(lines) == 6
    assert all("decompresses to more than 100 times" in line for line in lines[:3])
    assert all("a chunk does not" in line for line in lines[3:])
    assert int(ended.stdout) < 300


SCHEMA = Schema(id=1, name="a/msg/B", encoding="ros2msg", data=b"")
TOPIC = McapChannel(id=1, topic="/a", message_encoding="cdr", metadata={}, schema_id=1)


def message_bytes(size: int) -> bytes:
    return struct.pack("<BQHIQQ", 5, 22 + size, 1, 0, 1, 1) + bytes(size)


@pytest.mark.parametrize("more", [-1, 0, 1, 100])
def test_a_chunk_of_another_size_than_it_says_is_refused(tmp_path, more):
    message = message_bytes(8)
    made = chunk(zstandard.compress(message), len(message) + more)
    bag = Bag(crafted(tmp_path / "bag", *map(record_bytes, (SCHEMA, TOPIC, made))))
    if more:
        with pytest.raises(BagError, match="it is damaged"):
            list(bag.messages())
    else:
        assert [len(found.data) for found in bag.messages()] == [8]


def test_many_chunks_are_bounded_together(tmp_path):
    size = 30 * 2**20
    message = message_bytes(size)
    known = [record_bytes(SCHEMA), record_bytes(TOPIC)]
    chunks = [record_bytes(chunk(zstandard.compress(message), len(message)))]
    bag = Bag(crafted(tmp_path / "two", *known, *chunks * 2))
    assert [len(found.data) for found in bag.messages()] == [size, size]
    bag = Bag(crafted(tmp_path / "twenty", *known, *chunks * 20))
    with pytest.raises(BagError, match=r"decompresses to more than 100 times its size"):
        list(bag.messages())


@pytest.mark.parametrize("length", [0, 1, 5, 23, 2**40, 2**64 - 1])
def test_hostile_records_are_one_sentence_or_no_messages(tmp_path, length):
    for opcode in range(1, 16):
        record = struct.pack("<BQ", opcode, length) + b"\xff" * min(length, 100)
        try:
            assert list(Bag(crafted(tmp_path / f"{opcode}", record)).messages()) == []
        except BagError as error:
            assert "cannot be read, it is damaged" in str(error) and "\n" not in str(error)


@pytest.mark.parametrize("name", ["/\x1b]0;title\x07", "/two\nlines", "/" + "x" * 300])
def test_a_name_that_is_not_to_be_printed_is_refused(tmp_path, name):
    topic = McapChannel(id=1, topic=name, message_encoding="cdr", metadata={}, schema_id=0)
    with pytest.raises(BagError, match=r"damaged: a topic's name or type is '[ -~]+'; expected"):
        describe(crafted(tmp_path / "topic", record_bytes(topic)))


def test_the_records_of_a_chunk_are_read_one_by_one(tmp_path):
    """Those before one that is cut off have come when that is reached."""
    topic = McapChannel(id=1, topic="/a", message_encoding="cdr", metadata={}, schema_id=0)
    message = struct.pack("<BQHIQQ", 5, 22, 1, 0, 1, 1)
    content = record_bytes(topic) + message * 2 + message[:5]
    cut = record_bytes(chunk(zstandard.compress(content), len(content)))
    messages = Bag(crafted(tmp_path / "bag", cut)).messages()
    assert [next(messages).topic for _ in range(2)] == ["/a", "/a"]
    with pytest.raises(BagError, match="damaged"):
        next(messages)


def test_what_is_no_ordinary_file_in_a_bag_is_not_waited_for(tmp_path):
    bag = written(tmp_path)
    for name in ("parameters.json", "metadata.yaml", "bag.mcap"):
        (bag / name).unlink()
        os.mkfifo(bag / name)
        with pytest.raises(BagError, match=f"{name} cannot be read: it is not a regular file"):
            describe(bag)
        (bag / name).unlink()
        (bag / name).touch()


@pytest.mark.parametrize(
    ("change", "lacking"),
    [
        ({"step": 2**52}, f"lacks {2**52 + 1 - 6} of {2**52 + 1} states"),
        ({"step": 0}, "lacks steps: its cost is of step 0"),
        ({"values": np.zeros((1, 0))}, "lacks its cost"),
        ({"values": np.zeros((1, 1))}, "lacks its cost"),
    ],
)
def test_a_cost_that_no_episode_has_makes_it_incomplete(tmp_path, change, lacking):
    recording = Recording(tmp_path / "bag", WHAT)
    recorded_episode(recording, cost=change)
    recording.close()
    assert lacking in info_text(describe(tmp_path / "bag"))
    with pytest.raises(BagError, match="no complete episode"):
        identify_bag(tmp_path / "bag", {})


def test_states_of_several_shapes_make_an_episode_incomplete(tmp_path):
    recording = Recording(tmp_path / "bag", WHAT)
    recording.take(BY_TOPIC[STATE], 7 * SECOND, encode(STATE, frame(0, 2, 16)))
    recorded_episode(recording, skip=0)
    recording.close()
    text = info_text(describe(tmp_path / "bag"))
    assert "lacks states of one shape, a row for each environment" in text


def test_many_open_episodes_are_looked_through_seldom(monkeypatch):
    index, looked = EpisodeIndex(), 0

    def over(*_: object) -> bool:
        nonlocal looked
        looked += 1
        return False

    monkeypatch.setattr(RecordedEpisode, "over", over)
    start = np.array([(3.0, -1.0, 0.0, 0.0)])
    for episode in range(2000):
        raw = encode(START, Frame(RUN, episode, 0, 0.0, start))
        index.take(BY_TOPIC[START], episode, raw)
        assert index.take_over(episode) == []
    assert looked < 10 * 2000
    assert len(index.take_over(None)) == 2000


@pytest.mark.parametrize("value", [None, "x", {}, [], True, -1, 10**30])
@pytest.mark.parametrize("name", ["seed", "sensor_delays", "state_weight", "evaluation_fields"])
def test_parameters_of_a_bag_that_are_none_are_refused(tmp_path, name, value):
    bag = Path(shutil.copytree(OLD, tmp_path / "bag"))
    content = json.loads((bag / "parameters.json").read_text())
    ((run, values),) = content.items()
    words = f"parameter '{name}' is .*; expected|parameters.json cannot be read: expected whole"
    (bag / "parameters.json").write_text(json.dumps({run: values | {name: value}}))
    for read in (verify, partial(identify_bag, given={})):
        with pytest.raises((ParameterError, BagError), match=words):
            read(bag)


def test_a_damaged_chunk_is_noticed_by_its_checksum(tmp_path):
    path = written(tmp_path) / "bag.mcap"
    content = path.read_bytes()
    place = content.index(b"zstd") + 12
    path.write_bytes(content[:place] + b"\0" + content[place + 1 :])
    with pytest.raises(BagError, match=r"checksum|damaged"):
        list(Bag(path.parent).messages())


@settings(derandomize=True, deadline=None, database=None, max_examples=150)
@given(
    places=st.lists(st.tuples(st.floats(0, 1), st.integers(1, 255)), max_size=3),
    kept=st.floats(0, 1),
)
def test_a_damaged_bag_is_refused_in_a_sentence_or_gives_messages_that_were_recorded(
    undamaged, places, kept
):
    path, whole, content = undamaged
    damaged = bytearray(content)
    for place, flipped in places:
        damaged[int(place * (len(content) - 1))] ^= flipped
    path.write_bytes(damaged[: int(len(content) * (kept if kept > 0.5 else 1))])
    try:
        found = Counter((m.when, m.data) for m in Bag(path.parent).messages())
        list(Bag(path.parent).episodes())
    except BagError as error:
        assert "\n" not in str(error)
    else:
        assert found <= whole


@pytest.fixture(scope="module")
def undamaged(tmp_path_factory):
    """A bag's file, its messages and its content."""
    path = written(tmp_path_factory.mktemp("bag")) / "bag.mcap"
    messages = Counter((m.when, m.data) for m in Bag(path.parent).messages())
    return path, messages, path.read_bytes()


OLD = Path(__file__).parents[1] / "data" / "bag_0_1"


def test_a_bag_of_the_version_before_is_read_verified_and_identified_from(tmp_path):
    bag = Bag(OLD)
    assert bag.finished and len(list(bag.episodes())) == 5
    report = verify(OLD)
    assert (report.incomplete, len(report.notes)) == ([], 2), report.text()
    assert "another fingerprint of the plant" in report.notes[0]
    assert "the tuner's rollouts not known" in report.notes[1]  # its budget had other parts
    assert report.compared["targets"] == 1
    assert report.compared["costs"] == 1 + 8 + 2 * 2 + 3
    steps, compared = 30 * report.compared["costs"], report.compared["steps"]
    if report.differences:  # another processor than the recording one's: up to the first of each
        assert 0 < compared <= steps
    else:
        assert compared == steps
    for text in report.differences:
        recorded, again = map(float, re.findall(r"re(?:corded|computed) (\S+?)(?:,|$)", text))
        assert again == pytest.approx(recorded, rel=1e-6), text
    assert identify_bag(OLD, {}).steps > 0


def test_what_was_compared_is_numbers_and_what_cannot_be_verified_is_refused(tmp_path, capsys):
    main(["bag", "verify", str(OLD), "--json"])
    assert json.loads(capsys.readouterr().out)["compared"]["costs"] == 1 + 8 + 2 * 2 + 3
    assert main(["bag", "verify", str(OLD), "--equation", "kdv"]) == 1
    assert "--equation is kdv, but that of the run is burgers" in capsys.readouterr().err
    without = Path(shutil.copytree(OLD, tmp_path / "bag"))
    (without / "parameters.json").unlink()
    assert main(["bag", "verify", str(without)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("pdeloop: nothing was recomputed")
    assert "its parameters are not in the bag" in line


def test_another_target_than_the_plants_is_a_difference(monkeypatch):
    target = Bag(OLD).target()
    assert target is not None
    monkeypatch.setattr(Bag, "target", lambda bag: target + 1.0)
    monkeypatch.setattr(RecordedRun, "finish", lambda run, claims: None)
    assert verify(OLD).differences[0].startswith("target of run 1299076055067259, entry [0, 0]")


def test_a_bag_is_written_without_ros(tmp_path):
    program = (
        "import sys\n"
        "for name in ('rclpy', 'std_msgs', 'rosgraph_msgs'): sys.modules[name] = None\n"
        "from recorder_node.recording import Recording\n"
        "from recorder_node.sources import sources\n"
        "from pathlib import Path\n"
        f"Recording(Path({str(tmp_path / 'bag')!r}), sources('/')).close()\n"
    )
    python("-c", program)
    assert Bag(tmp_path / "bag").finished


def test_a_source_is_a_topic_of_its_namespace():
    assert isinstance(WHAT[0], Source)
    assert {s.channel.topic for s in WHAT} >= {"/left/state", "/left/model/failed", "/clock"}
    assert {s.channel.topic for s in sources("/")} >= {"/state", "/episode/start"}
