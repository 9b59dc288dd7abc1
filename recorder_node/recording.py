"""A recording: the loop's messages in one bag, or in one bag an episode, with their index. No ROS.

bag/bag.mcap, bag/metadata.yaml    the bag (or bag/episode-N/... with one bag an episode)
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

from loop_interfaces.protocol import ModelFailure
from loop_interfaces.topics import (
    ACTION,
    ARRAYS,
    COST,
    MODEL,
    MODEL_FAILED,
    MODEL_IDENTIFIED,
    POLICY,
    START,
    STATE,
    TARGET,
    Topic,
)
from recorder_node.bag import BagError, BagWriter, Channel
from recorder_node.episodes import SETTLING, Episode, EpisodeIndex, Key
from recorder_node.headers import HeaderReader

INDEX = "episodes.jsonl"
PARAMETERS = "parameters.json"
ARRAY_TYPE = "std_msgs/msg/Float64MultiArray"
TEXT_TYPE = "std_msgs/msg/String"
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"
CLOCK = "/clock"


@dataclass(frozen=True)
class Source:
    """A topic that is recorded: its channel in the bag, and what it is in the loop.

    array: its entry in loop_interfaces.topics, None for the others; namespace: its pair's.
    """

    channel: Channel
    array: Topic | None
    namespace: str

    @cached_property
    def sampled(self) -> bool:
        """Whether it is what comes by the hundred: states or actions."""
        return self.array in (STATE, ACTION)


def sources(namespace: str) -> list[Source]:
    """The topics of a pair in the absolute `namespace` ('/' or '/left')."""
    base = namespace.rstrip("/")
    namespace = base or "/"
    found = [
        Source(Channel(f"{base}/{topic.name}", ARRAY_TYPE, topic.latched), topic, namespace)
        for topic in ARRAYS
    ]
    failed = Channel(f"{base}/{MODEL_FAILED}", TEXT_TYPE, True)
    return [*found, Source(failed, None, namespace)]


def clock() -> Source:
    """Simulated time, one topic for all pairs."""
    return Source(Channel(CLOCK, CLOCK_TYPE, False), None, "")


class _Taken(NamedTuple):
    """A message to be written.

    key: of the episode whose bag it is for; episode: the one it is about, if that is not over.
    """

    source: Source
    when: int
    raw: bytes
    key: Key | None
    episode: Episode | None

    @property
    def early(self) -> bool:
        """Whether something should stand before it in the bag that has not come yet."""
        if self.episode is None:
            return False
        if self.source.array is POLICY:
            return not self.episode.started
        return self.source.array is COST and not self.episode.sampled


class Recording:
    """Writes what `take` is given.

    A plant sends its samples after the cost they make up, and a tuner the policies of an episode as
    soon as it has them. In the bag a cost stands behind its samples and policies behind the start:
    they wait, and what the pair says next waits behind them. So whenever this process may be killed,
    all episodes of a pair but the last are whole.

    path: a new folder; storage: 'mcap' or 'sqlite3'. Raises BagError when it cannot be written.
    """

    def __init__(
        self, path: Path, what: Sequence[Source], *, storage: str, bag_per_episode: bool
    ) -> None:
        self.path = path
        self.messages = 0
        self.episodes = 0
        self.incomplete = 0
        self._storage, self._split = storage, bag_per_episode
        self._channels = [source.channel for source in what]
        self._headers = {s.channel.topic: HeaderReader(s.array.labels) for s in what if s.array}
        self._index = EpisodeIndex()
        self._notes: dict[str, Any] = {}
        self._bag: BagWriter | None = None
        self._bags: dict[Key, BagWriter] = {}
        self._latched: dict[str, bytes] = {}
        self._newest: Key | None = None
        self._waiting: defaultdict[str, deque[_Taken]] = defaultdict(deque)
        """By namespace: one that came early, and what came after it."""
        if path.exists():
            raise BagError(f"{path} already exists; choose another folder for the bag")
        try:
            if bag_per_episode:
                path.mkdir(parents=True)
            else:
                self._bag = BagWriter(path, storage, self._channels)
            (path / INDEX).touch()
        except OSError as error:
            raise BagError(f"cannot write a bag to {path}: {error.strerror}") from error

    def take(self, source: Source, when: int, raw: bytes) -> None:
        """Record one message that arrived at `when` (ns since the epoch)."""
        key = self._attribute(source, when, raw) or self._newest
        self.messages += 1
        waiting = self._waiting[source.namespace]
        if source.sampled:
            self._write(source, when, raw, key)
        else:
            episode = self._index.find(key) if key else None
            waiting.append(_Taken(source, when, raw, key, episode))
        if waiting:
            self._let_go(waiting, when)

    def _let_go(self, waiting: deque[_Taken], now: int | None) -> None:
        """Write what need not wait at time `now` (ns); None: all."""
        while waiting:
            first = waiting[0]
            if now is not None and first.early and now - first.when <= SETTLING * 1e9:
                return
            waiting.popleft()
            self._write(first.source, first.when, first.raw, first.key)

    def _write(self, source: Source, when: int, raw: bytes, key: Key | None) -> None:
        if self._bag is not None:
            self._bag.write(source.channel.topic, when, raw)
            return
        if source.array in (MODEL, TARGET):
            self._latched[source.channel.topic] = raw
            for bag in self._bags.values():
                bag.write(source.channel.topic, when, raw)
        if key is not None:
            self._bag_of(key, when).write(source.channel.topic, when, raw)

    @property
    def run(self) -> int:
        """The run of the newest episode; 0 before the first."""
        return self._newest[1] if self._newest else 0

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
        for bag in self._open_bags():
            bag.pause()

    def flush(self) -> None:
        """Make everything so far survive a crash."""
        for bag in self._open_bags():
            bag.flush()

    def _open_bags(self) -> list[BagWriter]:
        return [*self._bags.values()] if self._bag is None else [self._bag]

    def index(self, now: int) -> None:
        """Index the episodes that are over at time `now` (ns): nothing more is expected of them."""
        for waiting in self._waiting.values():
            self._let_go(waiting, now)
        self._finish_episodes(now)

    def close(self) -> None:
        """Finish the bag or bags."""
        for waiting in self._waiting.values():
            self._let_go(waiting, None)
        self._finish_episodes(None)
        for bag in self._bags.values():
            bag.close(self._custom())
        self._bags.clear()
        if self._bag is not None:
            self._bag.close(self._custom())

    def _custom(self) -> dict[str, str]:
        return {"pdeloop.parameters": json.dumps(self._notes)} if self._notes else {}

    def _attribute(self, source: Source, when: int, raw: bytes) -> Key | None:
        """The episode a message belongs to, noted in the index; None if it belongs to none."""
        if source.array is None:
            return self._failed(source, when, raw) if source.channel.type == TEXT_TYPE else None
        headers = self._headers[source.channel.topic]
        ids = headers.ids(raw)
        if ids is None:
            return None
        run, number, step = ids
        key = (source.namespace, run, number)
        if source.sampled:
            self._index.sample(key, when, step, is_state=source.array is STATE)
        elif source.array in (MODEL, TARGET):
            return None
        elif source.array in (START, COST):
            frame = headers.frame(raw)
            if frame is None or not len(frame.values):
                return None  # the run is over: no episode
            note = self._index.start if source.array is START else self._index.cost
            note(key, when, frame)
        elif source.array is POLICY:
            self._index.see(key, when).policy = True
        elif source.array is MODEL_IDENTIFIED:
            self._index.see(key, when).model = True
        if self._newest is None or number >= self._newest[2] or run != self._newest[1]:
            self._newest = key
        return key

    def _failed(self, source: Source, when: int, raw: bytes) -> Key | None:
        try:
            failure = ModelFailure.from_json(raw[8:].rstrip(b"\0").decode())
        except ValueError:
            return None
        key = (source.namespace, failure.run, failure.episode)
        self._index.see(key, when).model = True
        return key

    def _bag_of(self, key: Key, when: int) -> BagWriter:
        bag = self._bags.get(key)
        if bag is None:
            path = self.path / _bag_name(key)
            if path.exists():  # a straggler of an episode that is over
                path = path.with_name(f"{path.name}-late-{when}")
            bag = self._bags[key] = BagWriter(path, self._storage, self._channels)
            for topic, raw in self._latched.items():
                bag.write(topic, when, raw)
        return bag

    def _finish_episodes(self, now: int | None) -> None:
        lines = []
        for episode in self._index.over(now):
            row = episode.row()
            bag = self._bags.pop(episode.key, None)
            if bag is not None:
                bag.close(self._custom())
                row["bag"] = bag.path.name
            lines.append(json.dumps(row) + "\n")
            self.episodes += 1
            self.incomplete += not row["complete"]
        if not lines:
            return
        try:
            with (self.path / INDEX).open("a") as file:
                file.write("".join(lines))
        except OSError as error:
            raise BagError(f"cannot write to {self.path}: {error.strerror}") from error


def _bag_name(key: Key) -> str:
    namespace, run, episode = key
    place = namespace.strip("/").replace("/", "-")
    return "-".join(filter(None, (place, f"run-{run}-episode-{episode:012d}")))
