# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reads the loop's messages back from an MCAP bag, and sorts them into episodes.

A bag was not finished if its recorder was killed, or the disk was full.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from pdeloop.bags.episodes import EpisodeIndex, RecordedEpisode
from pdeloop.bags.mcap_messages import CONVERTED, Message, files, in_time, text_of
from pdeloop.bags.survey import Findings, Survey, by_run, check, read_metadata, repeated, survey
from pdeloop.messages.arrays import Array
from pdeloop.messages.documents import parse_json
from pdeloop.messages.files import read_json
from recorder_node.bag import METADATA, BagError
from recorder_node.recording import EVERY, PARAMETERS, source_of
from tuner_node.run_folder import RunFolder

RUN_FILE = "run.json"
"""The file with a run's id next to its bags (tuner_node.run_folder)."""


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
        """True if it was closed properly."""
        closed = all(file.file.finished for file in self.survey.files)
        return closed and (self.path / METADATA).exists()

    @cached_property
    def survey(self) -> Survey:
        """The contents of its files."""
        return survey(self.files)

    def messages(self) -> Iterator[Message]:
        """The messages by the times at which they arrived, whatever their order in the files."""
        return in_time([file.file for file in self.survey.files])

    def target(self) -> Array | None:
        """The target z_r; None if the bag has none."""
        return self.survey.target

    def findings(self) -> Findings:
        """Files that are missing or contradict its metadata. BagError if unreadable."""
        told = read_metadata(self.path)
        found = Findings() if told is None else check(self.path, told, self.survey)
        found.differences += repeated(self.survey)
        found.missing += self.damage
        return found

    @property
    def damage(self) -> list[str]:
        """What of its files cannot be read, in words."""
        return [
            f"what is damaged of {file.name} ({text}); what is whole is read, and mcap recover "
            f"{file.name} -o FILE writes it to a file for other tools"
            for file in self.survey.files
            for text in file.file.damage
        ]

    def parameters(self) -> dict[int, dict[str, Any]]:
        """The nodes' parameters by run, where the bag or its source has them.

        They stand in the bag itself, if it was recorded by this version or a later one, and next to
        it; next to the bag that it was converted from, if it lies where our advice puts it; and in
        the folder of the run.
        """
        known: dict[int, dict[str, Any]] = {}
        origin = self.path.with_name(self.path.name.removesuffix(CONVERTED))
        for content in (
            _of_run(self.path.parent),
            _beside(origin / PARAMETERS),
            _beside(self.path / PARAMETERS),
            self.survey.parameters,
        ):
            for run, values in content.items():
                known[run] = known.get(run, {}) | values
        return known

    def contradicting_parameters(self) -> list[str]:
        """Differences between the parameters next to the bag and those in it, in words."""
        return [
            f"{PARAMETERS} differs from the bag itself in a parameter of run {run}: {name}"
            for run, values in _beside(self.path / PARAMETERS).items()
            for name, value in values.items()
            if value != self.survey.parameters.get(run, {}).get(name, value)
        ]

    def episodes(self) -> Iterator[RecordedEpisode]:
        """The episodes in the order of their ends, each when nothing more of it is to come."""
        every = {
            run: value
            for run, values in self.parameters().items()
            if type(value := values.get(EVERY)) is int and value > 0
        }
        index, known = EpisodeIndex(every), cache(source_of)
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


def _beside(path: Path) -> dict[int, dict[str, Any]]:
    """The parameters by run in a file that may be absent."""
    try:
        return by_run(parse_json(text_of(path) or "{}"))
    except ValueError as error:
        raise BagError(f"{path} cannot be read: {error}") from error


def _of_run(folder: Path) -> dict[int, dict[str, Any]]:
    """The parameters in the folder of a run, by its id; nothing where they are not there or damaged."""
    with suppress(ValueError, LookupError, TypeError):
        return {int(read_json(folder / RUN_FILE)["run"]): RunFolder(folder).parameters()}
    return {}
