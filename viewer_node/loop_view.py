"""What is known of the loop that is watched. Pure.

`now` is any monotonic time in s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.frames import Frame, Recent
from loop_interfaces.topics import VOID, CostColumn, StartColumn
from viewer_node.episode_samples import Episode, Key, key_of, rows_of
from viewer_node.learning_curve import LearningCurve
from viewer_node.loop_nodes import Health, Rate
from viewer_node.web.requests import Call

JOIN = 0.5
"""Seconds after which an episode is shown of which the beginning was missed."""
SILENT = 5.0
"""Seconds without a message after which a loop is not going."""
EXTREMES = (0.3, 99.7)
"""Percentiles of the field that the colours span, as in the report."""
STEADY = 0.15
"""Share of the colours' range by which it must change to be changed: they would only flicker."""
FAILURE = 15.0
"""Seconds for which a page says that a request failed."""
_MOST = 100
"""Episodes and plants that are remembered."""


@dataclass
class Request:
    """A service that a page asked for: since when; why and when it failed."""

    since: float
    failure: str = ""
    failed: float | None = None


class Watched:
    """One loop: its nodes, the newest episodes, its training.

    only: the run to watch, None for any; from_topics: whether the curve comes from the costs on the
    topics; begun: counts the episodes that were shown.
    """

    def __init__(self, *, only: int | None = None, from_topics: bool = True) -> None:
        self.only, self.from_topics = only, from_topics
        self.health = Health()
        self.curve = LearningCurve()
        self.rounds, self.episodes = Rate(), Rate()
        self.shown: Episode | None = None
        self.begun = 0
        self.targets: dict[int, NDArray[np.float64]] = {}
        self.parameters: dict[str, Any] = {}
        self.components = ["u"]
        self.controls: list[dict[str, Any]] = []
        self.run = 0
        self.kinds: dict[tuple[int, int], str] = {}
        """What the newest episodes are, by run and number."""
        self._pending: Episode | None = None
        self._pending_since = 0.0
        self._starts, self._policies = Recent(), Recent()
        self._costs_of: tuple[int, int] | None = None
        self._counted: tuple[Key, int] | None = None
        self._plant_paused = False
        self._paused: dict[str, float] = {}
        self._answered: dict[str, float] = {}
        self._requests: dict[Call, Request] = {}
        self._stopping: tuple[str, int] | None = None
        self._heard: float | None = None
        self._ended = False

    def state(self, frame: Frame, now: float, chosen: int) -> None:
        """Take z_k of all environments; chosen: the one to keep if not all can be kept."""
        if not self._wanted(frame, now, "plant"):
            return
        key = key_of(frame)
        for episode in (self.shown, self._pending):
            if episode is None or episode.key != key:
                continue
            if frame.step or not episode.last:
                episode.state(frame)
                break
        else:  # a new episode, or the same one again from its beginning: the plant was restarted
            self._pending, self._pending_since = (
                Episode.begin(frame, chosen, len(self.components)),
                now,
            )
            self._pending.state(frame)
        self.join(now)
        self._count(key, frame.step, now)

    def action(self, frame: Frame, now: float) -> None:
        """Take a_k of all environments."""
        if self._wanted(frame, now, "controller"):
            for episode in self._known(key_of(frame)):
                episode.action(frame)

    def start(self, frame: Frame, now: float) -> None:
        """Take the start of an episode; without rows it is the end of the run."""
        if not self._wanted(frame, now, "tuner"):
            return
        self._ended = not len(frame.values)
        if self._ended:
            return
        before = self._starts.newest
        if before is not None and before.run != frame.run and self.from_topics:
            self.curve = LearningCurve()
        self._starts.add(frame)
        explores = (frame.values[:, StartColumn.EXCITATION] >= 0).any()
        self.kinds[frame.run, frame.episode] = "exploration" if explores else "policy"
        if len(self.kinds) > _MOST:
            del self.kinds[next(iter(self.kinds))]

    def policy(self, frame: Frame, now: float) -> None:
        """Take the gains of an episode."""
        if self._wanted(frame, now, "tuner"):
            self._policies.add(frame)

    def cost(self, frame: Frame, now: float) -> None:
        """Take the costs of an episode that is over."""
        if not self._wanted(frame, now, "plant"):
            return
        key, ids = key_of(frame), (frame.run, frame.episode)
        for episode in self._known(key):
            episode.ended = True
        if self._costs_of == ids:
            return  # repeated
        self._costs_of = ids
        self._count(key, frame.step, now)
        if not (frame.values[:, CostColumn.ENDED] == VOID).any():
            self.episodes.add(1, now)
            self.health.heard(now, "controller")
        start = self._starts.of(frame)
        if start is not None and self.from_topics:
            self.curve.rollouts(start, self._policies.of(frame), frame)

    def target(self, frame: Frame, now: float) -> None:
        """Take z_r of a plant."""
        self.health.heard(now, "plant")
        if len(self.targets) > _MOST:
            self.targets.clear()
        self.targets[frame.plant] = frame.values

    def paused(self, frame: Frame, now: float) -> None:
        """Take whether an operator holds the plant."""
        self.health.heard(now, "plant")
        self._plant_paused = bool(frame.values.any())

    def asked(self, call: Call, now: float) -> None:
        """A page asks a node for something."""
        self._requests[call] = Request(now)

    def answered(self, call: Call, now: float, failure: str | None) -> None:
        """A node did what it was asked to, or not: then why."""
        if failure is not None:
            self._requests[call] = Request(now, failure, now)
            return
        self._requests.pop(call, None)
        self._answered[call.node] = now
        if call.verb == "pause":
            self._paused[call.node] = now
        elif call.verb in ("resume", "stop"):
            self._paused.pop(call.node, None)
        if call.verb == "stop":
            self._stopping = call.node, self.health.peers["tuner"].starts

    def requests(self, now: float) -> list[dict[str, Any]]:
        """What was asked for and is not answered yet, and what has just failed."""
        for call, request in list(self._requests.items()):
            if request.failed is not None and now - request.failed > FAILURE:
                del self._requests[call]
        roles = {peer.name: role for role, peer in self.health.peers.items() if peer.present}
        return [
            {
                "role": roles[call.node],
                "verb": call.verb,
                "seconds": round(now - request.since),
                "failure": request.failure,
            }
            for call, request in self._requests.items()
            if call.node in roles
        ]

    @property
    def stopping(self) -> bool:
        """Whether the tuner has agreed to stop, and is still there."""
        tuner = self.health.peers["tuner"]
        return tuner.present and self._stopping == (tuner.name, tuner.starts)

    def quiet(self, now: float) -> float | None:
        """Seconds since the last message of the loop; None before the first."""
        return None if self._heard is None else now - self._heard

    def join(self, now: float) -> None:
        """Show an episode of which the beginning was seen, or any if there is no better for long."""
        new = self._pending
        if new is not None and (
            new.whole or self.shown is None or now - self._pending_since > JOIN
        ):
            self.shown, self._pending = new, None
            self.begun += 1

    def held(self) -> list[str]:
        """The roles of the nodes that somebody holds."""
        found = []
        for role in ("plant", "tuner"):
            name = self.health.peers[role].name
            told = self.health.value(role, "paused", since=self._answered.get(name, 0.0))
            paused = self._plant_paused and role == "plant"
            there = self.health.peers[role].present
            if there and (paused or name in self._paused or told == "yes"):
                found.append(role)
        return found

    def doing(self, now: float) -> str:
        """What goes on, in one word."""
        # The last word of a tuner that was interrupted may be lost: then everybody is gone.
        nobody = not any(peer.present for peer in self.health.peers.values())
        if self._ended or (nobody and self._heard is not None):
            return "ended"
        if nobody:
            return "empty"
        if self.held():
            return "paused"
        if self._heard is None:
            return "waiting"
        return "running" if now - self._heard < SILENT else "silent"

    def colours(
        self, environment: int, component: int, before: tuple[float, float]
    ) -> tuple[float, float]:
        """The range of u that the colours span; `before` if it is hardly another one."""
        if self.shown is None:
            return before
        shown, part = self.shown, self.shown.part(component)
        seen = shown.fields[shown.row(environment), : shown.columns, part]
        seen = seen[np.isfinite(seen)]
        if not seen.size:
            return before
        some = seen[:: max(1, seen.size // 20_000)]
        low, high = (float(v) for v in np.percentile(some, EXTREMES))
        target = self.targets.get(shown.key[2])
        if target is not None:
            target = target[rows_of(len(target), shown.components)][part]
            low, high = min(low, float(target.min())), max(high, float(target.max()))
        if high - low < 1e-9:
            low, high = low - 0.5, high + 0.5
        size = STEADY * max(high - low, before[1] - before[0])
        same = abs(low - before[0]) <= size and abs(high - before[1]) <= size
        return before if same else (low, high)

    def _known(self, key: Key) -> list[Episode]:
        return [e for e in (self.shown, self._pending) if e is not None and e.key == key]

    def _wanted(self, frame: Frame, now: float, role: str) -> bool:
        if self.only is not None and frame.run != self.only:
            return False
        self.health.heard(now, role)
        self._heard, self.run = now, frame.run
        return True

    def _count(self, key: Key, step: int, now: float) -> None:
        """Count rounds, of which not every one was seen: an episode's last step says how many."""
        before = self._counted[1] if self._counted and self._counted[0] == key else 0
        if step > before:
            self.rounds.add(step - before, now)
            plant = self.health.peers["plant"].name
            if now - self._paused.get(plant, now) > SILENT:  # somebody else resumed it
                del self._paused[plant]
        self._counted = key, max(step, before)
