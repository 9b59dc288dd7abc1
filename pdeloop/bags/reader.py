# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reads the loop's messages back from an MCAP bag, and sorts them into episodes.

A bag was not finished if its recorder was killed, or the disk was full.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from loop_interfaces.arrays import Array
from loop_interfaces.documents import parse_json
from loop_interfaces.topics import TARGET
from pdeloop.bags.episodes import EpisodeIndex, RecordedEpisode
from pdeloop.bags.mcap_messages import Message, files, finished, read, text_of
from recorder_node.bag import METADATA, BagError
from recorder_node.recording import PARAMETERS
from recorder_node.sources import source_of


class Bag:
    """A recorded bag: a folder, or one in a run's folder. BagError where it cannot be read."""

    def __init__(self, path: Path) -> None:
        if not path.is_dir():
            raise BagError(f"no bag at {path}; give the folder of a rosbag2 bag")
        found = files(path)
        if not found and (path / "bag").is_dir():
            path = path / "bag"
            found = files(path)
        if not found:
            if (path / "parameters.yaml").exists():
                raise BagError(f"{path} is a run without a bag; pdeloop train --record records one")
            raise BagError(f"no bag in {path}: there is no .mcap file")
        self.path = path
        self.files = found

    @property
    def finished(self) -> bool:
        """Whether it was closed properly."""
        return all(map(finished, self.files)) and (self.path / METADATA).exists()

    def messages(self) -> Iterator[Message]:
        """The messages in the order in which they were written."""
        for file in self.files:
            yield from read(file)

    def target(self) -> Array | None:
        """The target z_r, which is among the first messages of a bag; None if it has none."""
        for message in self.messages():
            source = source_of(message.topic)
            if source is not None and source.array is TARGET:
                return source.codec.decode(message.data).values
        return None

    def parameters(self) -> dict[int, dict[str, Any]]:
        """The nodes' parameters by run, as far as the bag or the run's folder knows them."""
        try:
            content = parse_json(text_of(self.path / PARAMETERS) or "{}")
            return {int(run): dict(values) for run, values in content.items()}
        except (ValueError, TypeError, AttributeError) as error:
            raise BagError(f"{self.path / PARAMETERS} cannot be read: {error}") from error

    def episodes(self) -> Iterator[RecordedEpisode]:
        """The episodes in the order of their ends, each when nothing more of it is to come."""
        index, known = EpisodeIndex(), cache(source_of)
        for message in self.messages():
            source = known(message.topic)
            if source is not None:
                index.take(source, message.when, message.data)
                yield from index.take_over(message.when)
        yield from index.take_over(None)


def bags_of(path: Path) -> list[Bag]:
    """All bags of the run in the folder `path` (bag, bag-2, ...), or the one bag there."""
    numbered = [p for p in path.glob("bag*") if re.fullmatch(r"bag(-\d+)?", p.name)]
    if not numbered or files(path):
        return [Bag(path)]
    return [Bag(p) for p in sorted(numbered, key=lambda p: (len(p.name), p.name))]
