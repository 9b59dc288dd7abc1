"""A recording: the loop's messages in one bag, with an index of its episodes. No ROS.

bag/bag.mcap, bag/metadata.yaml    the bag
bag/episodes.jsonl                 one line an episode: where it is, and what is missing of it
bag/parameters.json                the nodes' parameters by run, as far as the nodes told them
"""

from __future__ import annotations

import json
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from loop_interfaces.frames import ArrayCodec, FrameError
from loop_interfaces.protocol import ModelFailure
from loop_interfaces.topics import (
    ACTION,
    ARRAYS,
    COST,
    MODEL,
    MODEL_FAILED,
    POLICY,
    START,
    STATE,
    TARGET,
    Topic,
)
from recorder_node.bag import BagError, BagWriter, Channel
from recorder_node.episodes import SETTLING, Episode, EpisodeIndex

INDEX = "episodes.jsonl"
PARAMETERS = "parameters.json"
ARRAY_TYPE = "std_msgs/msg/Float64MultiArray"
TEXT_TYPE = "std_msgs/msg/String"


@dataclass(frozen=True)
class Source:
    """A topic that is recorded: its channel in the bag, and what it is in the loop.

    array: its entry in loop_interfaces.topics, None for the others; namespace: its pair's, '' for
    what belongs to no pair.
    """

    channel: Channel
    array: Topic | None = None
    namespace: str = ""

    @cached_property
    def codec(self) -> ArrayCodec:
        """Decodes its messages, if it has arrays."""
        assert self.array is not None
        return ArrayCodec(self.array.labels)

    @cached_property
    def ordered(self) -> bool:
        """Whether it may have to wait for what belongs before it in the bag."""
        return bool(self.namespace) and self.array not in (STATE, ACTION)


CLOCK = Source(Channel("/clock", "rosgraph_msgs/msg/Clock"))
"""Simulated time, one topic for all pairs."""
DIAGNOSTICS = Source(Channel("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"))
ROSOUT = Source(Channel("/rosout", "rcl_interfaces/msg/Log", latched=True, depth=1000))


def sources(namespace: str) -> list[Source]:
    """The topics of a pair in the absolute `namespace` ('/' or '/left')."""
    base = namespace.rstrip("/")
    found = [
        Source(Channel(f"{base}/{topic.name}", ARRAY_TYPE, topic.latched), topic, base or "/")
        for topic in ARRAYS
    ]
    return [*found, Source(Channel(f"{base}/{MODEL_FAILED}", TEXT_TYPE, True), None, base or "/")]


class _Taken(NamedTuple):
    """A message to be written; episode: the one it is about, if any."""

    source: Source
    when: int
    raw: bytes
    episode: Episode | None

    @property
    def early(self) -> bool:
        """Whether something should stand before it in the bag that has not come yet."""
        if self.episode is None or self.episode.over:
            return False
        if self.source.array is POLICY:
            return not self.episode.started
        return self.source.array is COST and not self.episode.sampled


class Recording:
    """Writes the messages that `take` is given into the bag at `path`, a new folder.

    A plant sends its samples after the cost they make up, and a tuner the policies of an episode as
    soon as it has them. In the bag a cost stands behind its samples and policies behind the start:
    they wait, and what the pair says next waits behind them. So whenever this process may be killed,
    all episodes of a pair but the last are whole. Raises BagError when the bag cannot be written.
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
        self._waiting: defaultdict[str, deque[_Taken]] = defaultdict(deque)
        """By namespace: one that came early, and what came after it."""
        self._append_index("")

    def add(self, source: Source) -> None:
        """Record one more topic."""
        self._bag.add(source.channel)

    def take(self, source: Source, when: int, raw: bytes) -> None:
        """Record one message that arrived at `when` (ns since the epoch)."""
        self.messages += 1
        episode = self._note(source, when, raw)
        waiting = self._waiting[source.namespace]
        if source.ordered:
            waiting.append(_Taken(source, when, raw, episode))
        else:
            self._bag.write(source.channel.topic, when, raw)
        if waiting:
            self._write_waiting(waiting, when)

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
        for waiting in self._waiting.values():
            self._write_waiting(waiting, now)
        rows = [episode.row() for episode in self._index.take_over(now)]
        self.episodes += len(rows)
        self.incomplete += sum(not row["complete"] for row in rows)
        if rows:
            self._append_index("".join(json.dumps(row) + "\n" for row in rows))

    def close(self) -> None:
        """Finish the bag."""
        self.index(None)
        self._bag.close({"pdeloop.parameters": json.dumps(self._notes)} if self._notes else {})

    def _write_waiting(self, waiting: deque[_Taken], now: int | None) -> None:
        """Write what need not wait any more at time `now` (ns); None: all."""
        while waiting:
            first = waiting[0]
            if now is not None and first.early and now - first.when <= SETTLING * 1e9:
                return
            waiting.popleft()
            self._bag.write(first.source.channel.topic, first.when, first.raw)

    def _note(self, source: Source, when: int, raw: bytes) -> Episode | None:
        """Note a message in the index; the episode that it is about, if any."""
        topic = source.array
        if topic is None:
            return self._note_failure(source, when, raw) if source.ordered else None
        if topic in (MODEL, TARGET):
            return None
        try:
            frame = source.codec.decode(raw)
        except FrameError:
            return None  # the reader of the bag will not take it for one either
        if topic in (START, COST) and not len(frame.values):
            return None  # the run is over: no episode
        self.run = frame.run
        return self._index.note((source.namespace, frame.run, frame.episode), when, topic, frame)

    def _note_failure(self, source: Source, when: int, raw: bytes) -> Episode | None:
        try:
            failure = ModelFailure.from_json(raw[8:].rstrip(b"\0").decode())
        except ValueError:
            return None
        return self._index.note_model((source.namespace, failure.run, failure.episode), when)

    def _append_index(self, lines: str) -> None:
        try:
            with (self.path / INDEX).open("a") as file:
                file.write(lines)
        except OSError as error:
            raise BagError(f"cannot write to {self.path}: {error.strerror}") from error
