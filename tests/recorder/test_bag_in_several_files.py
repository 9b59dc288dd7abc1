# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A bag in several files is verified as one; a file that is lost, doubled or out of place is named."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pdeloop.bags.mcap_messages import Message, read
from pdeloop.bags.verify import verify
from pdeloop.cli import main
from tests.support.recorded_here import change_metadata, messages_of, write
from tests.support.verified_bag import EPISODES, by_episodes, verified, words_of


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
    assert "8 rollouts that the training asked for (adaptation 6, evaluation 2), in no" in missing
    assert "the bag has nothing of episodes 1.3 to 1.4" in missing


def test_a_file_that_is_cut_off_is_named(split):
    path = split / "bag_1.mcap"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    report = verify(split)
    assert "the end of bag_1.mcap: it is cut off" in report.missing
    assert any("bag_1.mcap has" in text for text in report.missing)


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
    assert "order bag_2.mcap, bag_1.mcap, bag_0.mcap, but their messages are in the" in difference
    assert not report.incomplete and not report.missing


def test_files_with_each_others_names_are_named(split):
    (split / "bag_0.mcap").rename(split / "x")
    (split / "bag_1.mcap").rename(split / "bag_0.mcap")
    (split / "x").rename(split / "bag_1.mcap")
    report = verify(split)
    assert not report.incomplete and not report.good
    assert "bag_0.mcap" in words_of(report) and "bag_1.mcap" in words_of(report)
