# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What is missing from a bag, or otherwise than its metadata and its run say, is named; rc 1."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from loop_interfaces.parameters import PLANT
from loop_interfaces.topics import TARGET
from pdeloop.bags.mcap_messages import Message, read
from pdeloop.bags.reader import Bag
from pdeloop.bags.report import Report
from pdeloop.bags.verify import verify
from pdeloop.cli import main
from pdeloop.identification import identify_bag
from recorder_node.bag import BagError
from recorder_node.sources import PARAMETERS_TOPIC, source_of
from tests.support.converted import convert
from tests.support.made_once import made_once
from tests.support.recorded_here import (
    PART,
    change_metadata,
    episode_of,
    messages_of,
    record_run,
    write,
)

EPISODES = 1 + 1 + 3 + 3
"""Exploration, check, three steps of four rollouts, and the evaluation's twelve."""


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with its bag."""

    def make(folder: Path) -> Path:
        record_run(folder / "run")
        return folder / "run"

    return made_once(tmp_path_factory, "verified", make)


@pytest.fixture
def run(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "run"))


@pytest.fixture(scope="module")
def original_messages(original: Path) -> tuple[Message, ...]:
    return tuple(messages_of(original / "bag"))


@pytest.fixture
def messages(original_messages: tuple[Message, ...]) -> list[Message]:
    return list(original_messages)


def by_episodes(messages: list[Message], *ends: int) -> list[list[Message]]:
    """The messages cut after these episodes, counted from 1; what is about none goes to the first."""
    edges = [PART - 1, *(PART - 1 + end for end in ends), 2**60]
    parts: list[list[Message]] = [[] for _ in edges[1:]]
    for message in messages:
        number = episode_of(message)
        part = next(i for i, edge in enumerate(edges[1:]) if number <= edge)
        parts[part].append(message)
    return parts


@pytest.fixture(scope="module")
def in_three(
    original: Path, original_messages: tuple[Message, ...], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The bag in three files: episodes 1 and 2, 3 and 4, and the others."""
    folder = write(
        tmp_path_factory.mktemp("in-three") / "bag", by_episodes(list(original_messages), 2, 4)
    )
    shutil.copy(original / "bag" / "parameters.json", folder)
    return folder


@pytest.fixture
def split(in_three: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(in_three, tmp_path / "split"))


def words_of(report: Report) -> str:
    return "\n".join([*report.missing, *report.differences, *report.incomplete, *report.notes])


def verified(*paths: Path) -> int:
    return main(["bag", "verify", *map(str, paths)])


def test_a_whole_run_is_verified_with_its_results(run, capsys):
    report = verify(run)
    assert report.good and not (report.incomplete or report.notes), report.text()
    assert report.episodes == EPISODES
    assert report.compared["results"] > 0
    assert verified(run) == 0
    assert capsys.readouterr().out.endswith("no difference, to the bit\n")


def test_a_run_whose_first_exploration_diverged_is_followed_and_identified_from_the_other(tmp_path):
    record_run(tmp_path / "run", exploration_variance=100.0, divergence_bound=3.2)
    report = verify(tmp_path / "run")
    assert report.good and not (report.incomplete or report.notes), report.text()
    found = identify_bag(tmp_path / "run" / "bag", {})
    assert {source["episode"] for source in found.sources} == {PART + 1}


NOTHING: dict[str, Callable[[dict[str, Any]], Any]] = {
    "as it is": lambda told: None,
    "without a storage": lambda told: told.update(storage_identifier=""),
    "of an older version": lambda told: [told.pop("files"), told.update(version=4)],
    "with the folder in front": lambda told: told.update(
        relative_file_paths=[f"split/{name}" for name in told["relative_file_paths"]]
    ),
    "files of before it was split": lambda told: told.update(
        files=[{**told["files"][0], "path": "bag.mcap"}]
    ),
}


@pytest.mark.parametrize("change", NOTHING)
def test_a_bag_in_several_files_is_verified(split, change):
    change_metadata(split, NOTHING[change])
    report = verify(split)
    assert report.good, report.text()
    assert report.episodes == EPISODES


def test_a_bag_without_metadata_is_verified(split):
    (split / "metadata.yaml").unlink()
    assert verify(split).good


@pytest.mark.parametrize(("lost", "episodes"), [(0, "1.1 to 1.2"), (1, "1.3 to 1.4"), (2, "")])
def test_a_lost_file_is_named_with_its_messages(split, capsys, lost, episodes):
    count = len(messages_of(split)) - len(messages_of_others(split, lost))
    (split / f"bag_{lost}.mcap").unlink()
    report = verify(split)
    named = f"the file bag_{lost}.mcap, which metadata.yaml names, with {count} messages"
    assert named in report.missing
    if episodes:
        assert f"nothing of episodes {episodes}" in words_of(report)
    assert verified(split) == 1
    told = capsys.readouterr()
    assert named in told.out + told.err
    assert "no difference" not in told.out
    assert main(["bag", "info", str(split)]) == 0
    assert named in capsys.readouterr().out


def messages_of_others(bag: Path, lost: int) -> list[Message]:
    return [m for p in sorted(bag.glob("*.mcap")) if f"_{lost}" not in p.name for m in read(p)]


def forget(lost: int) -> Callable[[dict[str, Any]], None]:
    """Take a file out of the metadata, with all that is said of it."""

    def change(told: dict[str, Any]) -> None:
        del told["relative_file_paths"][lost], told["files"][lost]
        for name in ("message_count", "starting_time", "duration", "topics_with_message_count"):
            told.pop(name)

    return change


@pytest.mark.parametrize("metadata", [True, False])
def test_a_lost_file_that_no_metadata_names_is_seen_in_what_the_training_asked_for(split, metadata):
    (split / "bag_1.mcap").unlink()
    if metadata:
        change_metadata(split, forget(1))
    else:
        (split / "metadata.yaml").unlink()
    report = verify(split)
    (missing,) = report.missing
    assert (
        "8 rollouts that the training asked for (adaptation 8), in no complete episode" in missing
    )
    assert "the bag has nothing of episodes 1.3 to 1.4" in missing


def test_a_lost_end_is_seen_by_what_the_run_says(run, messages):
    """The training's last episodes, of which the bag says nothing."""
    shutil.rmtree(run / "bag")
    write(run / "bag", by_episodes(messages, 4)[:1])
    assert verify(run / "bag").missing == verify(run).missing
    (missing,) = verify(run).missing
    assert "16 rollouts that the training asked for (adaptation 4, evaluation 12)" in missing
    elsewhere = run.parent / "bag"
    shutil.copytree(run / "bag", elsewhere)
    assert verify(elsewhere).good  # a recorder may have ended there
    (run / "result.json").unlink()
    (missing,) = verify(run).missing
    assert (
        "4 rollouts that the training asked for (adaptation 4)" in missing
    )  # as progress.jsonl says


def test_a_file_that_is_cut_off_is_named(split):
    path = split / "bag_1.mcap"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    report = verify(split)
    assert "the end of bag_1.mcap: it is cut off" in report.missing
    assert any("bag_1.mcap has" in text for text in report.missing)


def test_a_single_file_that_is_cut_off_is_named(run):
    path = run / "bag" / "bag.mcap"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "the end of bag.mcap: it is cut off" in words_of(verify(run))
    assert verified(run) == 1
    (run / "bag" / "metadata.yaml").unlink()  # as if the recorder had been killed
    assert verified(run) == 1


def test_files_that_are_there_twice_or_belong_to_nothing_are_named(split, tmp_path):
    shutil.copy(split / "bag_1.mcap", split / "bag_1 (copy).mcap")
    report = verify(split)
    assert "bag_1 (copy).mcap is in" in words_of(report)
    assert "holds the same messages as" in words_of(report)
    assert not report.good
    (split / "metadata.yaml").unlink()
    report = verify(split)
    assert "holds the same messages as" in words_of(report)
    assert not report.good


def test_a_file_in_the_place_of_another_is_named(split):
    shutil.copy(split / "bag_0.mcap", split / "bag_1.mcap")
    report = verify(split)
    words = words_of(report)
    assert "bag_1.mcap holds the same messages as bag_0.mcap" in words
    assert "bag_1.mcap has" in words and "metadata.yaml says" in words
    assert not report.good


def test_files_in_another_order_are_named_and_read_by_their_times(split):
    change_metadata(split, lambda told: told["relative_file_paths"].reverse())
    report = verify(split)
    (difference,) = report.differences
    assert "order bag_2.mcap, bag_1.mcap, bag_0.mcap, their messages are from" in difference
    assert not report.incomplete and not report.missing


def test_files_with_each_others_names_are_named(split):
    (split / "bag_0.mcap").rename(split / "x")
    (split / "bag_1.mcap").rename(split / "bag_0.mcap")
    (split / "x").rename(split / "bag_1.mcap")
    report = verify(split)
    assert not report.incomplete and not report.good
    assert "bag_0.mcap" in words_of(report) and "bag_1.mcap" in words_of(report)


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "more in all": (lambda m: m.update(message_count=m["message_count"] + 1), "says"),
    "more in a file": (
        lambda m: m["files"][0].update(message_count=m["files"][0]["message_count"] + 1),
        "bag.mcap has",
    ),
    "fewer in a file": (lambda m: m["files"][0].update(message_count=1), "metadata.yaml says 1"),
    "more in a topic": (
        lambda m: m["topics_with_message_count"][1].update(message_count=10**6),
        "of 1000000 of /",
    ),
    "another topic": (
        lambda m: m["topics_with_message_count"].append(
            {"topic_metadata": {"name": "/lost"}, "message_count": 3}
        ),
        "0 of 3 of /lost",
    ),
    "a topic less": (lambda m: m["topics_with_message_count"].pop(1), "of 0 of /"),
    "an earlier begin": (
        lambda m: m["starting_time"].update(nanoseconds_since_epoch=1),
        "metadata.yaml says from 1 to",
    ),
    "a longer file": (
        lambda m: m["files"][0]["duration"].update(nanoseconds=2),
        "the messages of bag.mcap are from",
    ),
    "a file twice": (lambda m: m["relative_file_paths"].append("bag.mcap"), "bag.mcap 2 times"),
    "a file more": (lambda m: m["relative_file_paths"].append("bag_1.mcap"), "the file bag_1.mcap"),
    "hostile names": (
        lambda m: m["relative_file_paths"].append("\x1b]0;t\x07" + "x" * 9000),
        r"the file \x1b]0;t\x07xxx",
    ),
    "no list of files": (lambda m: m.pop("relative_file_paths"), "is not what rosbag2 writes"),
    "no numbers": (lambda m: m.update(message_count="many"), "a number is 'many'"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_each_thing_that_metadata_says_is_compared(run, name):
    change, words = CHANGES[name]
    change_metadata(run / "bag", change)
    report = verify(run)
    assert not report.good
    assert words in words_of(report)
    assert max(map(len, words_of(report).splitlines())) < 1000
    assert "no difference" not in report.text()


def test_metadata_that_is_no_yaml_is_named_and_the_rest_verified(run):
    (run / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: {a: &a [*a]}\n")
    report = verify(run)
    assert "is not valid YAML" in words_of(report)
    assert report.compared["costs"] == 2 + 4 + 3 * 4 + 12


@pytest.mark.parametrize("topic", ["/state", "/action", "/episode/cost", "/policy"])
def test_a_single_message_that_is_nowhere_counted_is_missed(run, messages, topic):
    lost = next(m for m in messages if m.topic == topic and episode_of(m) == PART + 2)
    shutil.rmtree(run / "bag")
    write(run / "bag", [[m for m in messages if m is not lost]])
    report = verify(run)
    assert "episode 1.3 lacks" in words_of(report)
    assert "4 rollouts that the training asked for (adaptation 4)" in words_of(report)
    assert not report.good
    assert not verify(run / "bag").good


def test_an_episode_that_was_repeated_lacks_nothing(run, messages):
    """As after a plant that was killed: the tuner has started the same rollouts again."""
    number = PART + 2
    doubled: list[Message] = []
    for message in messages:
        own = episode_of(message)
        source = source_of(message.topic)
        if own >= number and source is not None and source.array is not None:
            frame = source.codec.decode(message.data)
            if own == number and message.topic in ("/policy", "/episode/start"):
                doubled.append(message)  # of the episode that came to nothing
            codec = source.array.codec()
            raw = codec.encode(replace(frame, episode=frame.episode + 1))
            doubled.append(replace(message, data=raw))
        else:
            doubled.append(message)
    shutil.rmtree(run / "bag")
    write(run / "bag", [doubled])
    report = verify(run)
    assert report.incomplete == ["episode 1.3 lacks its cost"]
    assert report.good, report.text()


@pytest.mark.parametrize("beside", [(), ("parameters.json",), ("metadata.yaml",)])
def test_the_file_of_a_bag_is_verified_alone(run, tmp_path, beside):
    """Copied without what was beside it; its parameters stand in it."""
    alone = tmp_path / "alone"
    alone.mkdir()
    for name in ("bag.mcap", *beside):
        shutil.copy(run / "bag" / name, alone)
    report = verify(alone)
    assert report.good and report.notes == [], report.text()
    assert identify_bag(alone, {}).model.A.shape == (4, 4)


def without_notes(run: Path, messages: list[Message]) -> None:
    """The bag as an earlier version wrote it: its parameters are only beside it."""
    kept = run.parent / "kept.json"
    shutil.copy(run / "bag" / "parameters.json", kept)
    shutil.rmtree(run / "bag")
    write(run / "bag", [[m for m in messages if m.topic != PARAMETERS_TOPIC]])
    shutil.copy(kept, run / "bag" / "parameters.json")


def test_parameters_are_found_in_the_folder_of_the_run(run, messages, tmp_path):
    without_notes(run, messages)
    assert verify(run).good
    (run / "bag" / "parameters.json").unlink()
    assert verify(run).good
    assert verify(run / "bag").good
    shutil.copytree(run / "bag", tmp_path / "copy")
    (note, *_) = verify(tmp_path / "copy").notes
    assert "its parameters are not in the bag" in note and "parameters.yaml of the run" in note
    assert verified(tmp_path / "copy") == 1


def test_a_plant_that_told_no_parameters_is_not_to_be_looked_for_in_a_file(run, messages):
    """As of a node of its own: those of controller and tuner are there."""
    without_notes(run, messages)
    (run / "parameters.yaml").unlink()
    path = run / "bag" / "parameters.json"
    known = json.loads(path.read_text())
    plant = {spec.name for spec in PLANT}
    kept = {run: {k: v for k, v in own.items() if k not in plant} for run, own in known.items()}
    path.write_text(json.dumps(kept))
    (note, *_) = verify(run / "bag").notes
    assert "its plant told no parameters" in note and "--parameters" not in note


@pytest.mark.parametrize("given", ["parameters.yaml", "parameters.json"])
def test_the_parameters_that_the_advice_names_are_taken(run, messages, tmp_path, given):
    without_notes(run, messages)
    bag = Path(shutil.copytree(run / "bag", tmp_path / "copy"))
    (bag / "parameters.json").unlink()
    file = run / given if given == "parameters.yaml" else run / "bag" / given
    assert main(["bag", "verify", str(bag), "--parameters", str(file)]) == 0


def test_parameters_in_a_later_bag_of_the_run_are_those_of_the_run(run, messages):
    without_notes(run, messages)
    shutil.rmtree(run / "bag")
    (run / "run.json").unlink()
    first, second = by_episodes(messages, 4)
    write(run / "bag", [[m for m in first if m.topic != PARAMETERS_TOPIC]])
    notes = [m for m in messages if m.topic == PARAMETERS_TOPIC]
    about_none = [m for m in first if m.topic == f"/{TARGET.name}" or m.topic == "/model"]
    write(run / "bag-2", [[*notes, *about_none, *second]])
    report = verify(run)
    assert report.good and report.notes == [], report.text()


def converted(refusal: str) -> None:
    """Follow the advice in a refusal."""
    convert(*shlex.split(refusal.split("onvert it: ")[1]))


@pytest.mark.parametrize("old", [False, True])
def test_a_bag_that_was_converted_as_we_advise_is_verified(run, messages, tmp_path, old):
    if old:
        without_notes(run, messages)
    sqlite = tmp_path / "lab"
    source = ("--src", str(run / "bag"), "--dst", str(sqlite), "--dst-storage", "sqlite3")
    convert("rosbags-convert", *source)
    shutil.copy(run / "bag" / "parameters.json", sqlite)
    with pytest.raises(BagError) as refused:
        Bag(sqlite)
    converted(str(refused.value))
    report = verify(tmp_path / "lab-mcap")
    assert report.good and not report.notes, report.text()
    assert identify_bag(tmp_path / "lab-mcap", {}).model.A.shape == (4, 4)


def test_a_file_that_rosbag2_compressed_is_verified_after_what_we_advise(run, tmp_path):
    bag = run / "bag"
    content = (bag / "bag.mcap").read_bytes()
    (bag / "bag.mcap.zstd").write_bytes(zstandard.compress(content))
    (bag / "bag.mcap").unlink()
    change_metadata(
        bag,
        lambda told: told.update(
            compression_format="zstd",
            compression_mode="FILE",
            relative_file_paths=["bag.mcap.zstd"],
        ),
    )
    with pytest.raises(BagError, match="is compressed by rosbag2") as refused:
        Bag(bag)
    converted(str(refused.value))
    assert verify(run / "bag-mcap").good


def test_a_bag_that_expands_too_far_is_read_after_what_we_advise(tmp_path):
    text = bytes.fromhex("00010000") + (2**20).to_bytes(4, "little") + bytes(2**20)
    talk = [Message("/talk", "std_msgs/msg/String", when, text) for when in range(100)]
    folder = write(tmp_path / "lab", [talk])
    with pytest.raises(BagError, match="decompresses to more than 100 times") as refused:
        messages_of(folder)
    converted(str(refused.value))
    assert len(messages_of(tmp_path / "lab-mcap")) == 100


RUN_FILES: dict[str, tuple[str, Callable[[dict[str, Any]], Any], str]] = {
    "a better cost": (
        "result.json",
        lambda c: c["costs_by_field"]["adapted"][0].__setitem__(0, 0.5),
        "'adapted' of",
    ),
    "another history": (
        "result.json",
        lambda c: c["history"][1].update(rollouts=99),
        "row 1: rollouts is 99",
    ),
    "a longer history": (
        "result.json",
        lambda c: c["history"].append(c["history"][-1]),
        "rows, the training has",
    ),
    "another run": ("run.json", lambda c: c.update(run=7), "all episodes of run 7"),
    "another horizon": (
        "run.json",
        lambda c: c["parameters"].update(horizon=31),
        "parameter 'horizon' is 30 in the bag and 31 in",
    ),
    "no run": ("run.json", lambda c: c.pop("run"), "run.json cannot be read: it lacks 'run'"),
    "no costs": ("result.json", lambda c: c.pop("costs_by_field"), "result.json cannot be read"),
    "parameters of another": (
        "bag/parameters.json",
        lambda c: next(iter(c.values())).update(horizon=31),
        "parameters.json has other parameters of run",
    ),
}


@pytest.mark.parametrize("name", RUN_FILES)
def test_what_the_run_says_is_compared(run, name):
    file, change, words = RUN_FILES[name]
    content = json.loads((run / file).read_text())
    change(content)
    (run / file).write_text(json.dumps(content))
    report = verify(run)
    assert not report.good
    assert words in words_of(report)


def test_another_policy_than_the_trainings_is_a_difference(run):
    with np.load(run / "policy.npz") as archive:
        arrays = dict(archive)
    arrays["policy"][0, 0, 0] = np.nextafter(arrays["policy"][0, 0, 0], 1.0)
    np.savez(run / "policy.npz", **arrays)
    assert f"the policy in {run}" in words_of(verify(run))


def test_gaps_in_the_numbers_are_named_where_no_training_can_be_followed(run, messages, tmp_path):
    parts = by_episodes([m for m in messages if m.topic != PARAMETERS_TOPIC], 2, 4)
    bag = write(tmp_path / "copy", parts[::2])
    assert any("episodes 1.3 to 1.4" in text for text in verify(bag).missing)
