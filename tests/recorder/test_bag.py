# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Bags: written from serialised bytes, read back by independent libraries, episode by episode."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

from pdeloop.bags.episodes import EpisodeIndex, RecordedEpisode
from pdeloop.bags.info import describe, info_text
from pdeloop.bags.reader import Bag, bags_of
from pdeloop.identification import identify_bag
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import START, STATE, episode_name, episode_number
from recorder_node.bag import BagError, definition
from recorder_node.recording import DIAGNOSTICS, ROSOUT, Recording, Source, sources
from tests.support.interpreter import python
from tests.support.written_bag import (
    BY_TOPIC,
    MESSAGES,
    RUN,
    SECOND,
    WHAT,
    encode,
    frame,
    recorded_episode,
    written,
)


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


def test_a_bag_is_written_without_ros(tmp_path):
    program = (
        "import sys\n"
        "for name in ('rclpy', 'std_msgs', 'rosgraph_msgs'): sys.modules[name] = None\n"
        "from recorder_node.recording import Recording\n"
        "from recorder_node.recording import sources\n"
        "from pathlib import Path\n"
        f"Recording(Path({str(tmp_path / 'bag')!r}), sources('/')).close()\n"
    )
    python("-c", program)
    assert Bag(tmp_path / "bag").finished


def test_a_source_is_a_topic_of_its_namespace():
    assert isinstance(WHAT[0], Source)
    assert {s.channel.topic for s in WHAT} >= {"/left/state", "/left/model/failed", "/clock"}
    assert {s.channel.topic for s in sources("/")} >= {"/state", "/episode/start"}
