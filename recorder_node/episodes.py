"""The index of a bag: which episodes are in it, when, and whether all of each was recorded. Pure."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from loop_interfaces.frames import Frame
from loop_interfaces.topics import (
    ACTION,
    COST,
    MODEL_IDENTIFIED,
    POLICY,
    START,
    STATE,
    VOID,
    CostColumn,
    StartColumn,
    Topic,
)

SETTLING = 0.3
"""Seconds after an episode's cost in which its other messages may still come in."""
MODEL_SETTLING = 10.0
"""The same after an exploratory episode, whose model is still to come."""

Key = tuple[str, int, int]
"""(namespace, run, episode)"""


@dataclass
class Episode:
    """What was recorded of one episode. first, last: arrival of its messages, ns since the epoch."""

    namespace: str
    run: int
    episode: int
    first: int
    last: int
    environments: int = 0
    exploratory: bool = False
    horizon: int = -1
    void: bool = False
    started: bool = False
    policy: bool = False
    model: bool = False
    states: set[int] = field(default_factory=set)
    actions: set[int] = field(default_factory=set)
    repeats: int = 0
    cost_at: int | None = None
    over: bool = False

    @property
    def key(self) -> Key:
        return self.namespace, self.run, self.episode

    @property
    def missing(self) -> list[str]:
        """What the bag lacks of this episode, in words; empty when it is complete."""
        lacking = [] if self.started else ["its start"]
        if self.started and not self.exploratory and not self.policy:
            lacking.append("its policies")
        if self.cost_at is None:
            return [*lacking, "its cost"]
        if self.void:
            return [*lacking, "an end: it is void"]
        states = self.horizon + 1 - len(self.states & set(range(self.horizon + 1)))
        actions = self.horizon - len(self.actions & set(range(self.horizon)))
        lacking += [f"{states} of {self.horizon + 1} states"] if states else []
        lacking += [f"{actions} of {self.horizon} actions"] if actions else []
        return lacking

    @property
    def sampled(self) -> bool:
        """Whether no more samples are awaited of it, now that its cost is there."""
        return self.void or (len(self.states) > self.horizon and len(self.actions) >= self.horizon)

    def settled(self, now: int) -> bool:
        """Whether nothing more is expected of it at time `now` (ns)."""
        if self.cost_at is None:
            return False
        waits = self.exploratory and not self.model and not self.void
        return now - self.cost_at > (MODEL_SETTLING if waits else SETTLING) * 1e9

    def given_up(self, now: int, newest: int) -> bool:
        """Whether it got no cost and has a successor, with number `newest`, of some age at `now` (ns).

        Episodes of a pair follow each other.
        """
        unended = self.cost_at is None and self.episode < newest
        return unended and now - self.last > MODEL_SETTLING * 1e9

    def add(self, steps: set[int], step: int) -> None:
        """Note a sample among the `steps` that there are."""
        if step in steps:
            self.repeats += 1
        steps.add(step)

    def row(self) -> dict[str, Any]:
        """Its line in the index."""
        content = asdict(self)
        for name in ("started", "policy", "model", "cost_at", "over"):
            del content[name]
        content |= {"states": len(self.states), "actions": len(self.actions)}
        return content | {"complete": not self.missing, "missing": self.missing}


class EpisodeIndex:
    """Follows the messages of a recording and tells which episodes are over."""

    def __init__(self) -> None:
        self._open: dict[Key, Episode] = {}

    def note(self, key: Key, when: int, topic: Topic, frame: Frame) -> Episode:
        """Note a message that arrived at `when` (ns) in its episode, and return that."""
        episode = self._see(key, when)
        if topic is STATE:
            episode.add(episode.states, frame.step)
        elif topic is ACTION:
            episode.add(episode.actions, frame.step)
        elif topic is START:
            episode.started = True
            episode.environments = len(frame.values)
            episode.exploratory = bool((frame.values[:, StartColumn.EXCITATION] >= 0).any())
        elif topic is COST:
            episode.cost_at = when
            episode.horizon = frame.step
            episode.void = bool((frame.values[:, CostColumn.ENDED] == VOID).any())
        elif topic is POLICY:
            episode.policy = True
        elif topic is MODEL_IDENTIFIED:
            episode.model = True
        return episode

    def note_model(self, key: Key, when: int) -> Episode:
        """Note that an episode's model came, or why there is none."""
        episode = self._see(key, when)
        episode.model = True
        return episode

    def take_over(self, now: int | None) -> list[Episode]:
        """Take out the episodes of which nothing more is expected at time `now` (ns); None: all."""
        newest = max((e.episode for e in self._open.values()), default=-1)
        done = [
            episode
            for episode in self._open.values()
            if now is None or episode.settled(now) or episode.given_up(now, newest)
        ]
        for episode in done:
            episode.over = True
            del self._open[episode.key]
        return sorted(done, key=lambda episode: episode.first)

    def _see(self, key: Key, when: int) -> Episode:
        """The episode a message belongs to, a new one if it is the first of it."""
        found = self._open.get(key)
        if found is None:
            found = self._open[key] = Episode(*key, first=when, last=when)
        elif when < found.first:
            found.first = when
        elif when > found.last:
            found.last = when
        return found
