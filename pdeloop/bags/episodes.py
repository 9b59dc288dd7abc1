# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The episodes of a bag: what belongs to each, and whether all of it was recorded. Pure.

A reader follows the messages with it in the order in which they were recorded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.protocol import ModelFailure
from pdeloop.messages.topics import (
    ACTION,
    COST,
    MODEL,
    MODEL_IDENTIFIED,
    POLICY,
    START,
    STATE,
    TARGET,
    VOID,
    CostColumn,
    StartColumn,
    episode_name,
    start_rows,
)
from recorder_node.recording import Source

SETTLING, MODEL_SETTLING = 0.3, 10.0
"""Seconds after an episode's last message in which further ones may still come; the longer ones for an
episode without its cost or its model."""
REMEMBERED = 1000
"""Episodes that were taken out and whose late messages are recognised as such."""

Key = tuple[str, int, int]
"""(namespace, run, episode)"""
_ONCE = {START: "start", POLICY: "policy", COST: "cost", MODEL_IDENTIFIED: "model"}
"""The messages that there are once an episode, and the attributes that hold them."""


@dataclass
class RecordedEpisode:
    """The recording of one episode: its messages by topic, states and actions by step.

    key: namespace, run, and number of the episode; first, last: arrival of its first and last message,
    ns since the epoch; model: what `model/identified` said; failure: why there is no model; bases: the
    models that its policies are about; contradictions: messages that were recorded twice with different
    content, in words; state_every: steps from one state that was to be recorded to the next; asked,
    stamps: the times (s) of all its starts, and of all its states.
    """

    key: Key
    first: int
    last: int
    start: Frame | None = None
    policy: Frame | None = None
    cost: Frame | None = None
    model: Frame | None = None
    states: dict[int, Frame] = field(default_factory=dict)
    actions: dict[int, Frame] = field(default_factory=dict)
    failure: ModelFailure | None = None
    bases: Frame | None = None
    contradictions: list[str] = field(default_factory=list)
    state_every: int = 1
    asked: set[float] = field(default_factory=set)
    stamps: set[float] = field(default_factory=set)

    @property
    def number(self) -> int:
        return self.key[2]

    @property
    def name(self) -> str:
        return episode_name(self.number)

    @property
    def environments(self) -> int:
        return 0 if self.start is None else len(self.start.values)

    @property
    def exploratory(self) -> bool:
        rows = None if self.start is None else self.start.values
        return rows is not None and bool((rows[:, StartColumn.EXCITATION] >= 0).any())

    @property
    def void(self) -> bool:
        """True if the plant declared it void."""
        rows = None if self.cost is None else self.cost.values
        return rows is not None and bool((rows[:, CostColumn.ENDED] == VOID).any())

    @property
    def horizon(self) -> int:
        """Number of its steps; -1 before its cost is known."""
        return -1 if self.cost is None else self.cost.step

    @property
    def missing(self) -> list[str]:
        """The missing parts of this episode in words; empty if it is complete."""
        lacking = [] if self.start is not None else ["its start"]
        if self.start is not None and not self.exploratory and self.policy is None:
            lacking.append("its policies")
        if self.cost is None:
            return [*lacking, "its cost"]
        if self.void:
            return [*lacking, "an end: it is void"]
        if self.horizon < 1:
            return [*lacking, "steps: its cost is of step 0"]
        for samples, steps, name in (
            (self.states, range(0, self.horizon + 1, self.state_every), "states"),
            (self.actions, range(self.horizon), "actions"),
        ):
            lost = len(steps) - sum(step in steps for step in samples)
            lacking += [f"{lost} of {len(steps)} {name}"] if lost else []
            shapes = {frame.values.shape for frame in samples.values()}
            if len(shapes) > 1 or any(shape[0] != self.environments for shape in shapes):
                lacking.append(f"{name} of one shape, a row for each environment")
        return lacking

    def trajectory(self) -> tuple[Array, Array]:
        """States (T + 1, M, n_z), those that were to be recorded, and actions (T, M, n_a).

        Of a complete episode.
        """
        assert not self.missing
        states = [self.states[k].values for k in range(0, self.horizon + 1, self.state_every)]
        return np.stack(states), np.stack([self.actions[k].values for k in range(self.horizon)])

    def over(self, now: int, newest: int) -> bool:
        """True if nothing more is expected of it at time `now` (ns).

        Episodes of a pair follow each other: one without a cost is given up when there is a later one,
        `newest` being the largest number.
        """
        if self.cost is None and self.number >= newest:
            return False
        model = self.model is not None or self.failure is not None or self.void
        waits = self.cost is None or (self.exploratory and not model)
        return now - self.last > (MODEL_SETTLING if waits else SETTLING) * 1e9

    def put(self, source: Source, frame: Frame) -> None:
        """Keep a message."""
        assert source.array is not None
        topic, before = source.array, None
        if topic in (START, STATE):
            (self.asked if topic is START else self.stamps).add(frame.time)
        if topic in (STATE, ACTION):
            samples = self.states if topic is STATE else self.actions
            before, samples[frame.step] = samples.get(frame.step), frame
        else:
            before = getattr(self, _ONCE[topic])
            setattr(self, _ONCE[topic], frame)
        if before is not None and before.values.tobytes() != frame.values.tobytes():
            self.contradictions.append(
                f"{topic.name} of step {frame.step} was recorded twice with different values"
            )


class EpisodeIndex:
    """Sorts messages into episodes and tells which of these are over.

    every: steps from one recorded state to the next, by run, where not all were recorded.
    """

    def __init__(self, every: Mapping[int, int] | None = None) -> None:
        self._every = every or {}
        self._open: dict[Key, RecordedEpisode] = {}
        self._over: deque[Key] = deque(maxlen=REMEMBERED)
        self._models: dict[Key, Frame] = {}
        """By namespace, run and number of the models."""
        self._since = 0
        """Calls of `take_over` since it looked for the last time."""

    def take(self, source: Source, when: int, raw: bytes) -> RecordedEpisode | None:
        """Note a message that arrived at `when` (ns); the episode that it is about, if any."""
        if source.array is None:
            return self._take_failure(source, when, raw) if source.namespace else None
        if source.array is TARGET:
            return None
        try:
            frame = source.codec.decode(raw)
            rows = start_rows(frame) if source.array is START else frame.values
        except FrameError:
            return None
        if source.array is MODEL:
            self._models[source.namespace, frame.run, frame.step] = frame
            return None
        if source.array in (START, COST) and not len(rows):
            return None  # the run is over: no episode
        if source.array is COST and rows.shape[1] != len(CostColumn):
            return None
        episode = self._find((source.namespace, frame.run, frame.episode), when)
        if episode is not None:
            episode.put(source, frame)
        return episode

    def take_over(self, now: int | None) -> list[RecordedEpisode]:
        """Take out the episodes of which nothing more is expected at time `now` (ns); None: all.

        It looks as often as leaves the work of a call the same, however many episodes are open.
        """
        self._since += 1
        if now is not None and self._since < len(self._open):
            return []
        self._since = 0
        newest = max((e.number for e in self._open.values()), default=-1)
        done = [
            episode for episode in self._open.values() if now is None or episode.over(now, newest)
        ]
        for episode in done:
            if episode.start is not None:
                models = (*episode.key[:2], episode.start.step)
                episode.bases = self._models.get(models)
            self._over.append(episode.key)
            del self._open[episode.key]
        return sorted(done, key=lambda episode: episode.first)

    def _take_failure(self, source: Source, when: int, raw: bytes) -> RecordedEpisode | None:
        try:
            failure = ModelFailure.from_json(raw[8:].rstrip(b"\0").decode())
        except ValueError:
            return None
        episode = self._find((source.namespace, failure.run, failure.episode), when)
        if episode is not None:
            episode.failure = failure
        return episode

    def _find(self, key: Key, when: int) -> RecordedEpisode | None:
        """The episode a message belongs to, a new one if it is its first; None if that is over."""
        if key not in self._open:
            if key in self._over:
                return None
            every = self._every.get(key[1], 1)
            self._open[key] = RecordedEpisode(key, when, when, state_every=every)
        episode = self._open[key]
        episode.first, episode.last = min(episode.first, when), max(episode.last, when)
        return episode
