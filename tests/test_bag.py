"""Bags: written from serialised bytes, read back by independent libraries, safe against what breaks."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from loop_interfaces.frames import ArrayCodec, Frame
from loop_interfaces.topics import ACTION, COST, POLICY, START, STATE
from pdeloop.bags.reader import Bag
from pdeloop.bags.tools import recover
from recorder_node.bag import STORAGES, BagError
from recorder_node.headers import HeaderReader
from recorder_node.recording import Recording, Source, clock, sources
from tests.small_disk import read_only_folder, small_disk

RUN = 2**52 + 1
SECOND = 10**9
WHAT = [*sources("/left"), clock()]
BY_TOPIC = {source.array: source for source in WHAT if source.array}


def frame(step: int, *shape: int, episode: int = 7) -> Frame:
    values = np.random.default_rng([step, *shape]).standard_normal(shape)
    return Frame(RUN, episode, step, 0.25 * step, values, 99)


def encode(topic, content: Frame) -> bytes:
    return ArrayCodec(topic.labels).encode(content)


def recorded_episode(
    recording: Recording, episode: int = 7, steps: int = 5, skip: int = -1
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
    take(COST, Frame(RUN, episode, steps, 0.0, np.array([(1.0, 5.0, -1.0)]), 99))


def written(folder: Path, storage: str, split: bool = False, **how: int) -> Path:
    path = folder / "bag"
    recording = Recording(path, WHAT, storage=storage, bag_per_episode=split)
    recording.take(WHAT[-1], SECOND, bytes.fromhex("00010000") + bytes(8))
    for episode in (7, 8):
        recorded_episode(recording, episode, **how)
    recording.note(RUN, {"n_z": 16})
    recording.close()
    return path


@pytest.mark.parametrize("storage", STORAGES)
def test_rosbags_reads_what_was_written_with_its_definitions(tmp_path, storage):
    path = written(tmp_path, storage)
    with AnyReader([path]) as reader:
        assert reader.message_count == 1 + 2 * (1 + 6 + 6 + 1)
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
    path = written(tmp_path, "mcap")
    with (path / "bag.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics.message_count == 29
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        seen = 0
        for _, channel, _, message in reader.iter_decoded_messages(topics="/left/state"):
            sent = frame(int(message.data[2]), 1, 16, episode=int(message.data[1]))
            assert list(message.data[5:]) == sent.values.ravel().tolist()
            assert channel.topic == "/left/state"
            seen += 1
        assert seen == 12


def test_sqlite3_holds_the_schema_of_jazzy(tmp_path):
    path = written(tmp_path, "sqlite3")
    with sqlite3.connect(path / "bag.db3") as connection:
        assert connection.execute("SELECT schema_version FROM schema").fetchone() == (4,)
        (text,) = connection.execute(
            "SELECT encoded_message_definition FROM message_definitions "
            "WHERE topic_type = 'std_msgs/msg/Float64MultiArray'"
        ).fetchone()
        assert "float64[] data" in text
    connection.close()


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("split", [False, True], ids=["one bag", "one an episode"])
def test_an_episode_is_found_through_the_index(tmp_path, storage, split):
    bag = Bag(written(tmp_path, storage, split))
    assert [(row["episode"], row["complete"]) for row in bag.index()] == [(7, True), (8, True)]
    (found,) = bag.find(8)
    assert found.missing == []
    states, actions = found.trajectory()
    assert states.shape == (6, 1, 16) and actions.shape == (5, 1, 4)
    assert np.array_equal(states[3], frame(3, 1, 16, episode=8).values)
    if not split:
        row = bag.index()[1]
        between = list(bag.messages(row["first"], row["last"] + 1))
        assert len(between) == 14  # nothing else had to be read
    assert bag.parameters() == {RUN: {"n_z": 16}}
    with AnyReader(bag.parts) as reader:
        assert reader.message_count >= 28


@pytest.mark.parametrize("storage", STORAGES)
def test_a_lost_sample_makes_the_episode_incomplete(tmp_path, storage):
    bag = Bag(written(tmp_path, storage, skip=2))
    assert [row["missing"] for row in bag.index()] == [["1 of 6 states"]] * 2
    assert [episode.missing for episode in bag.episodes()] == [["1 of 6 states"]] * 2


@pytest.mark.parametrize("storage", STORAGES)
def test_what_was_flushed_is_readable_without_an_end_and_can_be_recovered(tmp_path, storage):
    path = tmp_path / "bag"
    recording = Recording(path, WHAT, storage=storage, bag_per_episode=False)
    recorded_episode(recording, 7)
    recording.flush()
    recording.index(7 * SECOND)
    recorded_episode(recording, 8)  # never flushed: as if killed now
    if storage == "sqlite3":
        copy = tmp_path / "killed"
        copy.mkdir()
        for file in path.iterdir():
            (copy / file.name).write_bytes(file.read_bytes())
        path = copy
    bag = Bag(path)
    assert not bag.finished
    assert [episode.number for episode in bag.episodes()] == [7]
    target, messages = recover(path, None)
    assert messages == 14
    with AnyReader([target]) as reader:
        assert reader.message_count == 14
    assert Bag(target).finished


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("lost", [False, True])
def test_a_cost_waits_for_the_samples_that_it_is_about(tmp_path, storage, lost):
    recording = Recording(tmp_path / "bag", WHAT, storage=storage, bag_per_episode=False)
    early, samples = [], []

    def take(topic, content: Frame, when: int) -> None:
        recording.take(BY_TOPIC[topic], when, encode(topic, content))

    for episode in (7, 8):
        rows = np.array([(3.0, 4.0, 0.1, 0.0)])
        early.append((POLICY, Frame(RUN, episode, 0, 0.0, np.ones((1, 2, 3)))))
        early.append((START, Frame(RUN, episode, 0, 0.0, rows)))
        early.append((COST, Frame(RUN, episode, 5, 0.0, np.array([(1.0, 5.0, -1.0)]), 99)))
        for step in range(6):
            samples.append((STATE, frame(step, 1, 16, episode=episode)))
            samples.append((ACTION, frame(step, 1, 4, episode=episode)))
    for topic, content in early:
        take(topic, content, SECOND)
        recording.flush()
        began = (topic, content.episode) != (POLICY, 7)
        assert len(list(Bag(tmp_path / "bag").episodes())) == began
    for topic, content in samples:
        recording.flush()  # as if it were killed now
        whole = [not episode.missing for episode in Bag(tmp_path / "bag").episodes()]
        assert lost or all(whole[:-1]), (topic, content.episode, content.step)
        if not (lost and topic is STATE and content.step == 3):
            take(topic, content, SECOND)
    recording.index(SECOND + SECOND // 2)  # nothing more is waited for
    recording.flush()
    assert [not e.missing for e in Bag(tmp_path / "bag").episodes()] == [not lost] * 2
    recording.close()
    assert recording.messages == 6 + 24 - 2 * lost
    with AnyReader([tmp_path / "bag"]) as reader:
        assert reader.message_count == recording.messages


@pytest.mark.parametrize("storage", STORAGES)
def test_of_a_batch_all_survives_or_nothing(tmp_path, storage):
    recording = Recording(tmp_path / "bag", WHAT, storage=storage, bag_per_episode=False)
    raw = encode(STATE, frame(0, 8, 1024))  # 64 kB

    def survivors() -> int:
        shutil.rmtree(tmp_path / "killed", ignore_errors=True)
        shutil.copytree(tmp_path / "bag", tmp_path / "killed")
        return sum(1 for _ in Bag(tmp_path / "killed").messages())

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
    recording = Recording(path, WHAT, storage="mcap", bag_per_episode=False)
    for episode in (7, 8):
        recorded_episode(recording, episode)
        recording.flush()
        recording.index(episode * SECOND)
    file = path / "bag.mcap"
    os.truncate(file, file.stat().st_size - 2000 - cut)
    assert next(Bag(path).episodes()).number == 7


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("split", [False, True], ids=["one bag", "one an episode"])
def test_an_existing_bag_is_not_touched(tmp_path, storage, split):
    (tmp_path / "bag").mkdir()
    with pytest.raises(BagError, match="already exists; choose another folder"):
        Recording(tmp_path / "bag", WHAT, storage=storage, bag_per_episode=split)
    assert list((tmp_path / "bag").iterdir()) == []


@pytest.mark.parametrize("storage", STORAGES)
def test_a_folder_that_cannot_be_written_is_a_clear_error(tmp_path, storage):
    with (
        read_only_folder(tmp_path / "locked") as folder,
        pytest.raises(BagError, match=r"cannot write a bag to .*(Read-only|Permission)"),
    ):
        Recording(folder / "bag", WHAT, storage=storage, bag_per_episode=False)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_full_disk_stops_the_recording_and_keeps_what_was_written(tmp_path, storage):
    with small_disk(tmp_path / "disk", megabytes=1) as disk:
        recording = Recording(disk / "bag", WHAT, storage=storage, bag_per_episode=False)

        def fill() -> None:
            for episode in range(1000):
                recorded_episode(recording, episode, steps=50)
                recording.flush()
                recording.index(episode * SECOND)

        with pytest.raises(BagError, match=r"(No space left|disk is full).*; recording stopped"):
            fill()
        episodes = [e for e in Bag(disk / "bag").episodes() if not e.missing]
        assert len(episodes) > 5
        target, _ = recover(disk / "bag", tmp_path / "recovered")
        with AnyReader([target]) as reader:
            assert reader.message_count >= len(episodes) * 104


def test_headers_are_read_without_decoding():
    reader = HeaderReader(STATE.labels)
    for step in range(3):
        raw = encode(STATE, frame(step, 2, 16))
        for bytes_ in (raw, raw + b"\0\0"):  # RTPS may pad
            assert reader.ids(bytes_) == (RUN, 7, step)
    assert reader.ids(b"nonsense") is None
    assert reader.ids(encode(STATE, frame(4, 1, 16))) == (RUN, 7, 4)


def test_what_is_no_bag_is_a_clear_error(tmp_path):
    for path, words in (
        (tmp_path / "none", "no bag at"),
        (tmp_path, "there is neither a metadata"),
    ):
        with pytest.raises(BagError, match=words):
            Bag(path)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: [1")
    (tmp_path / "x.mcap").write_bytes(b"nonsense")
    with pytest.raises(BagError, match="cannot be read"):
        list(Bag(tmp_path).messages())


def test_a_bag_is_written_without_ros(tmp_path):
    program = (
        "import sys\n"
        "for name in ('rclpy', 'std_msgs', 'rosgraph_msgs'): sys.modules[name] = None\n"
        "from recorder_node.recording import *\n"
        "from pathlib import Path\n"
        f"Recording(Path({str(tmp_path / 'bag')!r}), sources('/'), storage='mcap',"
        " bag_per_episode=False).close()\n"
    )
    root = Path(__file__).resolve().parent.parent
    subprocess.run([sys.executable, "-c", program], cwd=root, check=True, timeout=60)
    assert Bag(tmp_path / "bag").finished


def test_a_source_is_a_topic_of_its_namespace():
    assert isinstance(WHAT[0], Source)
    assert {s.channel.topic for s in WHAT} >= {"/left/state", "/left/model/failed", "/clock"}
    assert {s.channel.topic for s in sources("/")} >= {"/state", "/episode/start"}
