"""The index of a bag: which episodes are in it, when, and whether all of each was recorded. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

from loop_interfaces.frames import Frame
from loop_interfaces.topics import VOID, CostColumn, StartColumn

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

    def row(self) -> dict[str, Any]:
        """Its line in the index."""
        content = asdict(self)
        for name in ("started", "policy", "model", "cost_at"):
            del content[name]
        content |= {"states": len(self.states), "actions": len(self.actions)}
        return content | {"complete": not self.missing, "missing": self.missing}


class EpisodeIndex:
    """Follows the messages of a recording and tells which episodes are over."""

    def __init__(self) -> None:
        self._open: dict[Key, Episode] = {}

    def see(self, key: Key, when: int) -> Episode:
        """The episode a message belongs to, a new one if it is the first of it."""
        found = self._open.get(key)
        if found is None:
            found = self._open[key] = Episode(*key, first=when, last=when)
        elif when < found.first:
            found.first = when
        elif when > found.last:
            found.last = when
        return found

    def find(self, key: Key) -> Episode | None:
        """An episode that is not over."""
        return self._open.get(key)

    def start(self, key: Key, when: int, frame: Frame) -> Episode:
        """Note an episode's start."""
        episode = self.see(key, when)
        episode.started = True
        episode.environments = len(frame.values)
        episode.exploratory = bool((frame.values[:, StartColumn.EXCITATION] >= 0).any())
        return episode

    def sample(self, key: Key, when: int, step: int, *, is_state: bool) -> Episode:
        """Note a state or an action."""
        episode = self.see(key, when)
        steps = episode.states if is_state else episode.actions
        if step in steps:
            episode.repeats += 1
        steps.add(step)
        return episode

    def cost(self, key: Key, when: int, frame: Frame) -> Episode:
        """Note an episode's cost."""
        episode = self.see(key, when)
        episode.cost_at = when
        episode.horizon = frame.step
        episode.void = bool((frame.values[:, CostColumn.ENDED] == VOID).any())
        return episode

    def over(self, now: int | None) -> Iterator[Episode]:
        """Take out the episodes of which nothing more is expected; None: all."""
        done = [e for e in self._open.values() if now is None or e.settled(now)]
        newest = max((e.episode for e in self._open.values()), default=-1)
        if now is not None:
            # Episodes of a pair follow each other: one that got no cost and has a successor of some
            # age was given up.
            done += [
                e
                for e in self._open.values()
                if e.cost_at is None and e.episode < newest and now - e.last > MODEL_SETTLING * 1e9
            ]
        for episode in sorted(done, key=lambda e: e.first):
            del self._open[episode.key]
            yield episode
