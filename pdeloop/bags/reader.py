"""Reads the loop's messages back from an MCAP bag, finished or not, anybody's, and sorts them into
episodes.

A bag was not finished if its recorder was killed, or the disk was full.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.frames import ArrayCodec, Frame, FrameError
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
    StartColumn,
    Topic,
)
from pdeloop.bags.mcap_messages import MAX_TEXT, McapMessages, Message, files
from recorder_node.bag import METADATA, BagError, Channel
from recorder_node.episodes import MODEL_SETTLING, SETTLING, Key
from recorder_node.recording import INDEX, PARAMETERS

Array = NDArray[np.float64]
_ATTRIBUTES = {START: "start", POLICY: "policy", COST: "cost", MODEL_IDENTIFIED: "model"}
_BY_NAME = sorted(ARRAYS, key=lambda topic: -len(topic.name))


@dataclass
class RecordedEpisode:
    """What a bag holds of one episode.

    states, actions: by step; contradictions: samples recorded twice with different content;
    model: what `model/identified` said; bases: the models in use when it ended.
    """

    key: Key
    first: int
    last: int
    start: Frame | None = None
    policy: Frame | None = None
    cost: Frame | None = None
    states: dict[int, Frame] = field(default_factory=dict)
    actions: dict[int, Frame] = field(default_factory=dict)
    model: Frame | None = None
    failure: ModelFailure | None = None
    bases: Frame | None = None
    contradictions: list[str] = field(default_factory=list)

    @property
    def number(self) -> int:
        return self.key[2]

    @property
    def exploratory(self) -> bool:
        rows = None if self.start is None else self.start.values
        return rows is not None and bool((rows[:, StartColumn.EXCITATION] >= 0).any())

    @property
    def missing(self) -> list[str]:
        """What a complete episode has and this one lacks, in words."""
        lacking = [] if self.start is not None else ["its start"]
        if self.cost is None:
            return [*lacking, "its cost"]
        horizon = self.cost.step
        states = sum(k not in self.states for k in range(horizon + 1))
        actions = sum(k not in self.actions for k in range(horizon))
        lacking += [f"{states} of {horizon + 1} states"] if states else []
        lacking += [f"{actions} of {horizon} actions"] if actions else []
        return lacking

    def trajectory(self) -> tuple[Array, Array]:
        """States (T + 1, M, n_z) and actions (T, M, n_a) of a complete episode."""
        assert self.cost is not None and not self.missing
        steps = range(self.cost.step)
        states = [self.states[k].values for k in (*steps, self.cost.step)]
        return np.stack(states), np.stack([self.actions[k].values for k in steps])


class Bag:
    """A bag at `path`: its folder, or a run's folder with a bag in it.

    Raises BagError when there is none, or it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_dir():
            raise BagError(f"no bag at {path}; give the folder of a rosbag2 bag")
        found = files(path)
        if not found and (path / "bag").is_dir():
            path = path / "bag"
            found = files(path)
        if not found:
            raise BagError(f"no bag in {path}: there is no .mcap file")
        self.path = path
        self.files = found

    @property
    def finished(self) -> bool:
        """Whether it was closed properly."""
        complete = all(McapMessages(file).finished for file in self.files)
        return complete and (self.path / METADATA).exists()

    def channels(self) -> list[Channel]:
        """Its topics, by name."""
        found = [channel for file in self.files for channel in McapMessages(file).channels.values()]
        return sorted(
            {channel.topic: channel for channel in found}.values(),
            key=lambda channel: channel.topic,
        )

    def messages(self, start: int | None = None, stop: int | None = None) -> Iterator[Message]:
        """The messages in the order of their arrival, those in [start, stop) ns if given."""
        for file in self.files:
            yield from McapMessages(file).messages(start, stop)

    def find(self, episode: int) -> Iterator[RecordedEpisode]:
        """The episodes of this number: through the index, without a scan, if the bag has one."""
        rows = [row for row in self.index() if row.get("episode") == episode]
        for row in rows:
            window = int(row["first"]), int(row["last"]) + 1
            yield from (e for e in self.episodes(*window) if e.number == episode)
        if not rows:
            yield from (e for e in self.episodes() if e.number == episode)

    def target(self) -> Array | None:
        """The target z_r, which is among the first messages of a bag; None if it has none."""
        codec = ArrayCodec(TARGET.labels)
        for message in self.messages():
            if message.topic.endswith(f"/{TARGET.name}"):
                return codec.decode(message.data).values
        return None

    def index(self) -> list[dict[str, Any]]:
        """The recorder's index of episodes; empty if another recorder wrote the bag."""
        rows = []
        for line in _text(self.path / INDEX).splitlines():
            try:
                rows.append(dict(json.loads(line)))
            except (ValueError, TypeError, RecursionError):
                continue  # the line that was being written when the recorder was killed
        return rows

    def parameters(self) -> dict[int, dict[str, Any]]:
        """The nodes' parameters by run, as far as the bag or the run's folder knows them."""
        try:
            content = json.loads(_text(self.path / PARAMETERS) or "{}")
            return {int(run): dict(values) for run, values in content.items()}
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise BagError(f"{self.path / PARAMETERS} cannot be read: {error}") from error

    def episodes(
        self, start: int | None = None, stop: int | None = None
    ) -> Iterator[RecordedEpisode]:
        """The episodes in the order of their ends, each when nothing more of it is to come.

        start, stop: only what lies in this time (ns), as `index` gives it for an episode.
        """
        collector = _Collector()
        for message in self.messages(start, stop):
            collector.take(message)
            yield from collector.over(message.when)
        yield from collector.over(None)


class _Collector:
    """Sorts messages into episodes."""

    def __init__(self) -> None:
        self._codecs: dict[str, tuple[Topic, str, ArrayCodec] | None] = {}
        self._open: dict[Key, RecordedEpisode] = {}
        self._ended: dict[Key, int] = {}
        self._closed: set[Key] = set()
        self._models: dict[tuple[str, int, int], Frame] = {}

    def take(self, message: Message) -> None:
        if message.topic.endswith(f"/{MODEL_FAILED}"):
            self._take_failure(message)
            return
        if message.topic not in self._codecs:
            self._codecs[message.topic] = _recognise(message.topic)
        known = self._codecs[message.topic]
        if known is None:
            return
        topic, namespace, codec = known
        try:
            frame = codec.decode(message.data)
        except FrameError:
            return
        if topic is TARGET:
            return
        if topic is MODEL:
            self._models[namespace, frame.run, frame.step] = frame
            return
        if topic is START and not len(frame.values):
            return
        episode = self._episode((namespace, frame.run, frame.episode), message.when)
        if episode is not None:
            self._put(episode, topic, frame, message.when)

    def over(self, now: int | None) -> Iterator[RecordedEpisode]:
        if now is None:
            done = sorted(self._open)
        else:
            done = [key for key, when in self._ended.items() if self._settled(key, now - when)]
        for key in done:
            episode = self._open.pop(key)
            self._ended.pop(key, None)
            if episode.start is not None:
                episode.bases = self._models.get((key[0], key[1], episode.start.step))
            self._closed.add(key)
            yield episode

    def _settled(self, key: Key, age: int) -> bool:
        episode = self._open[key]
        waits = episode.exploratory and episode.model is None and episode.failure is None
        return age > (MODEL_SETTLING if waits else SETTLING) * 1e9

    def _episode(self, key: Key, when: int) -> RecordedEpisode | None:
        if key in self._closed:
            return None
        episode = self._open.setdefault(key, RecordedEpisode(key, when, when))
        episode.last = max(episode.last, when)
        return episode

    def _put(self, episode: RecordedEpisode, topic: Topic, frame: Frame, when: int) -> None:
        if topic in (STATE, ACTION):
            samples = episode.states if topic is STATE else episode.actions
            before = samples.setdefault(frame.step, frame)
            same = before.values.tobytes() == frame.values.tobytes()
        else:
            name = _ATTRIBUTES[topic]
            before = getattr(episode, name) or frame
            setattr(episode, name, before)
            same = before.values.tobytes() == frame.values.tobytes()
            if topic is COST and episode.key not in self._ended:
                self._ended[episode.key] = when
        if not same:
            episode.contradictions.append(
                f"{topic.name} of step {frame.step} was recorded twice with different values"
            )

    def _take_failure(self, message: Message) -> None:
        try:
            failure = ModelFailure.from_json(message.data[8:].rstrip(b"\0").decode())
        except ValueError:
            return
        namespace = message.topic.removesuffix(MODEL_FAILED)
        key = (namespace.rstrip("/") or "/", failure.run, failure.episode)
        if key in self._open:
            self._open[key].failure = failure


def _recognise(name: str) -> tuple[Topic, str, ArrayCodec] | None:
    """The loop's topic of this full name, its namespace and a codec; None for any other topic."""
    for topic in _BY_NAME:
        if name.endswith(f"/{topic.name}"):
            return topic, name.removesuffix(f"/{topic.name}") or "/", ArrayCodec(topic.labels)
    return None


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(MAX_TEXT).decode(errors="replace")
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise BagError(f"{path} cannot be read: {error.strerror}") from error
