# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A recording that ends early keeps what it has written: killed, a full disk, a folder in use."""

from __future__ import annotations

import os
from typing import Any

import pytest

from pdeloop.bags.reader import Bag
from pdeloop.messages.topics import STATE
from recorder_node import bag as bag_module
from recorder_node.bag import BagError
from recorder_node.recording import Recording
from tests.support.small_disk import read_only_folder, small_disk
from tests.support.written_bag import (
    BY_TOPIC,
    SECOND,
    WHAT,
    encode,
    frame,
    killed,
    recorded_episode,
)


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

        with pytest.raises(BagError, match=r"No space left.*; recording has stopped"):
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
    with pytest.raises(BagError, match=r"No space left on device; recording has stopped"):
        for episode in range(8, 20):
            recorded_episode(recording, episode, steps=30)
    assert (tmp_path / "bag" / "bag.mcap").stat().st_size == size
