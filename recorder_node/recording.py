"""A recording: the loop's messages in one bag, with an index of its episodes. No ROS.

bag/bag.mcap, bag/metadata.yaml    the bag
bag/episodes.jsonl                 one line per episode: where it is, and what is missing of it
bag/parameters.json                the nodes' parameters by run, as far as they have answered
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from recorder_node.bag import BagError, BagWriter
from recorder_node.episodes import EpisodeIndex
from recorder_node.sources import Source

INDEX = "episodes.jsonl"
PARAMETERS = "parameters.json"


class Recording:
    """Writes the messages that `take` is given into the bag at `path`, a new folder.

    Raises BagError when the bag cannot be written.
    """

    def __init__(self, path: Path, what: Sequence[Source]) -> None:
        self.path = path
        self.messages = 0
        self.episodes = 0
        self.incomplete = 0
        self.run = 0
        """That of the newest episode; 0 before the first."""
        self._index = EpisodeIndex()
        self._notes: dict[str, Any] = {}
        self._bag = BagWriter(path, [source.channel for source in what])
        self._append_index("")

    def take(self, source: Source, when: int, raw: bytes) -> None:
        """Record one message that arrived at `when` (ns since the epoch)."""
        self.messages += 1
        episode = self._index.take(source, when, raw)
        if episode is not None:
            self.run = episode.key[1]
        self._bag.write(source.channel.topic, when, raw)

    def note(self, run: int, parameters: Mapping[str, Any]) -> None:
        """Keep the parameters of a run, beside what is already known of them."""
        self._notes[str(run)] = self._notes.get(str(run), {}) | dict(parameters)
        try:
            part = self.path / (PARAMETERS + ".part")
            part.write_text(json.dumps(self._notes, indent=1))
            part.replace(self.path / PARAMETERS)
        except OSError as error:
            raise BagError(f"cannot write to {self.path}: {error.strerror}") from error

    def pause(self) -> None:
        """All that arrived up to some moment was taken."""
        self._bag.pause()

    def flush(self) -> None:
        """Make everything so far survive a crash."""
        self._bag.flush()

    def index(self, now: int | None) -> None:
        """Index the episodes that are over at time `now` (ns), None: all; nothing more is expected of
        them.
        """
        rows = [episode.row() for episode in self._index.take_over(now)]
        self.episodes += len(rows)
        self.incomplete += sum(not row["complete"] for row in rows)
        if rows:
            self._append_index("".join(json.dumps(row) + "\n" for row in rows))

    def close(self) -> None:
        """Finish the bag."""
        self.index(None)
        self._bag.close({"pdeloop.parameters": json.dumps(self._notes)} if self._notes else {})

    def _append_index(self, lines: str) -> None:
        try:
            with (self.path / INDEX).open("a") as file:
                file.write(lines)
        except OSError as error:
            raise BagError(f"cannot write to {self.path}: {error.strerror}") from error
