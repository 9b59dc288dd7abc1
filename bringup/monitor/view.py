"""What the page is told: everything the monitor knows of the loop it watches. Pure.

One thread puts in what comes from the topics, another takes out what a page does not have yet; each
method holds the lock for as long as it runs, which is short. `now` is any monotonic time in s.
"""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bringup.monitor.curve import Curve
from bringup.monitor.episode import Episode, Key, key_of, rows_of
from bringup.monitor.health import Endpoint, Health, Rate
from loop_interfaces.frames import Frame
from loop_interfaces.topics import VOID, CostColumn, StartColumn

JOIN = 0.5
"""Seconds after which an episode is shown of which the beginning was missed."""
SILENT = 2.0
"""Seconds without a message after which a loop is not going."""
FRESH = 0.5
"""Seconds between two looks at the range of the colours."""
EXTREMES = (0.3, 99.7)
"""Percentiles of the field that the colours span, as in the report."""
_LENGTH = struct.Struct("<I")


@dataclass
class Cursor:
    """What one page has been told so far."""

    status: int = -1
    curve: int = -1
    target: int = -1
    episode: Key | None = None
    environment: int = -1
    begun: int = -1
    stride: int = 0
    column: int = 0
    shown: tuple[int, int, bool] = (-1, -1, False)


@dataclass
class _Open:
    """The newest start and policy, until the cost of that episode comes."""

    start: Frame | None = None
    policy: Frame | None = None
    told: tuple[int, int] = (0, -1)


@dataclass
class _Loop:
    """What belongs to the loop that is watched now; another one begins with a new one."""

    health: Health = field(default_factory=Health)
    curve: Curve = field(default_factory=Curve)
    rounds: Rate = field(default_factory=Rate)
    episodes: Rate = field(default_factory=Rate)
    open: _Open = field(default_factory=_Open)
    kinds: dict[tuple[int, int], str] = field(default_factory=dict)
    """What the newest episodes are, by run and number."""
    shown: Episode | None = None
    pending: Episode | None = None
    pending_since: float = 0.0
    counted: tuple[Key, int] | None = None
    targets: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    controls: list[dict[str, Any]] = field(default_factory=list)
    plant_paused: bool = False
    paused: dict[str, float] = field(default_factory=dict)
    answered: dict[str, float] = field(default_factory=dict)
    heard: float | None = None
    ended: bool = False
    run: int = 0


class View:
    """All of it, for the monitor's life.

    environment: index in the batch that is shown.
    """

    def __init__(self, environment: int = 0) -> None:
        self._lock = threading.Lock()
        self._loop = _Loop()
        self._place: dict[str, Any] = {"domain": None, "folder": None, "namespace": None}
        self._environment = environment
        self._only: int | None = None
        self._begun = 0
        self._status = b"{}"
        self._versions = {"status": 0, "target": 0, "begun": 0}
        self._range = (0.0, 1.0)
        self._ranged = float("-inf")
        self._from_topics = True

    # From the topics.

    def watch(self, place: Mapping[str, Any], *, run: int | None, from_topics: bool) -> None:
        """Begin with another loop.

        place: domain, folder, namespace and namespaces of it, for people; run: the only one to
        show; from_topics: whether the curve comes from the costs on the topics.
        """
        with self._lock:
            self._loop = _Loop()
            self._begun += 1
            self._place = {**place, "begun": self._begun}
            self._only, self._from_topics = run, from_topics
            for name in self._versions:
                self._versions[name] += 1

    @property
    def run(self) -> int:
        """The run of the newest message; 0 before the first."""
        with self._lock:
            return self._loop.run

    def follow(self, folder: str) -> None:
        """The curve comes from the lines of the run in `folder` from now on (`progress`)."""
        with self._lock:
            self._place["folder"], self._from_topics = folder, False
            self._loop.curve = Curve()

    def namespaces(self, found: list[str]) -> None:
        """The loops in this domain, by namespace."""
        with self._lock:
            self._place["namespaces"] = found

    def choose(self, environment: int) -> None:
        """Show another environment."""
        with self._lock:
            self._environment = environment
            self._ranged = float("-inf")

    def state(self, frame: Frame, now: float) -> None:
        """Take z_k of all environments."""
        with self._lock:
            if not self._wanted(frame, now, "plant"):
                return
            loop, key = self._loop, key_of(frame)
            for episode in (loop.shown, loop.pending):
                again = episode is not None and frame.step == 0 and episode.last > 0
                if episode is not None and episode.key == key and not again:
                    episode.state(frame)
                    break
            else:
                loop.pending, loop.pending_since = Episode.begin(frame, self._environment), now
                loop.pending.state(frame)
            self._join(now)
            self._count(key, frame.step, now)

    def action(self, frame: Frame, now: float) -> None:
        """Take a_k of all environments."""
        with self._lock:
            if not self._wanted(frame, now, "controller"):
                return
            for episode in (self._loop.shown, self._loop.pending):
                if episode is not None and episode.key == key_of(frame):
                    episode.action(frame)

    def start(self, frame: Frame, now: float) -> None:
        """Take the start of an episode; without rows it is the end of the run."""
        with self._lock:
            if not self._wanted(frame, now, "tuner"):
                return
            self._loop.ended = not len(frame.values)
            if len(frame.values):
                self._loop.open.start = frame
                explores = (frame.values[:, StartColumn.EXCITATION] >= 0).any()
                kinds = self._loop.kinds
                kinds[frame.run, frame.episode] = "exploration" if explores else "policy"
                if len(kinds) > 100:
                    del kinds[next(iter(kinds))]

    def policy(self, frame: Frame, now: float) -> None:
        """Take the gains of an episode."""
        with self._lock:
            if self._wanted(frame, now, "tuner"):
                self._loop.open.policy = frame

    def cost(self, frame: Frame, now: float) -> None:
        """Take the costs of an episode that is over."""
        with self._lock:
            if not self._wanted(frame, now, "plant"):
                return
            loop, key = self._loop, key_of(frame)
            for episode in (loop.shown, loop.pending):
                if episode is not None and episode.key == key:
                    episode.ended = True
            opened, ids = loop.open, (frame.run, frame.episode)
            if opened.told == ids:
                return  # repeated
            opened.told = ids
            self._count(key, frame.step, now)
            if not (frame.values[:, CostColumn.ENDED] == VOID).any():
                loop.episodes.add(1, now)
                loop.health.heard(now, "controller")
            start, policy = opened.start, opened.policy
            if start is None or (start.run, start.episode) != ids or not self._from_topics:
                return
            known = policy is not None and (policy.run, policy.episode) == ids
            loop.curve.rollouts(start, policy if known else None, frame)

    def paused(self, frame: Frame, now: float) -> None:
        """Take whether an operator holds the plant."""
        with self._lock:
            self._loop.health.heard(now, "plant")
            self._loop.plant_paused = bool(frame.values.any())

    def target(self, frame: Frame, now: float) -> None:
        """Take z_r of a plant."""
        with self._lock:
            self._loop.health.heard(now, "plant")
            if len(self._loop.targets) > 100:
                self._loop.targets.clear()
            self._loop.targets[frame.plant] = frame.values
            self._versions["target"] += 1

    # From the graph, the services and the run's folder.

    def look(self, found: Mapping[str, Iterable[Endpoint]], controls: list[dict[str, Any]]) -> None:
        """Take who publishes what, by role, and which nodes offer which services."""
        with self._lock:
            self._loop.health.look(found)
            self._loop.controls = controls

    def parameters(self, values: Mapping[str, Any]) -> None:
        """Take parameters that a node told."""
        with self._lock:
            loop = self._loop
            loop.parameters |= values
            if isinstance(values.get("iterations"), int) and not self._from_topics:
                loop.curve.total = values["iterations"]

    def progress(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Take new lines of the run's progress.jsonl."""
        with self._lock:
            for row in rows:
                self._loop.curve.row(row)

    def diagnosis(
        self, name: str, level: int, message: str, values: Iterable[tuple[str, str]], now: float
    ) -> None:
        """Take a status from /diagnostics."""
        with self._lock:
            self._loop.health.diagnosis(name, level, message, values, now)

    def answered(self, node: str, verb: str, now: float) -> None:
        """A node did what it was asked to."""
        with self._lock:
            self._loop.answered[node] = now
            if verb == "pause":
                self._loop.paused[node] = now
            elif verb in ("resume", "stop"):
                self._loop.paused.pop(node, None)

    @property
    def complete(self) -> bool:
        """Whether the episode that is shown is over, and was seen from its beginning."""
        with self._lock:
            shown = self._loop.shown
            return shown is not None and shown.ended and shown.whole

    def offers(self, node: str, verb: object) -> bool:
        """Whether `node` is one of this loop's and has the service `verb`."""
        with self._lock:
            return any(c["node"] == node and verb in c["verbs"] for c in self._loop.controls)

    def known_namespaces(self) -> list[str]:
        """The loops in this domain, by namespace."""
        with self._lock:
            return list(self._place.get("namespaces") or [])

    # To the page.

    def refresh(self, now: float) -> None:
        """Put the status together again; call it now and then."""
        with self._lock:
            loop = self._loop
            self._join(now)
            shown = loop.shown
            names = ("problem", "length", "n_z", "n_a", "horizon", "sample_time", "optimizer")
            status = {
                "part": "status",
                "place": self._place,
                "state": self._state(now),
                "parameters": {
                    n: loop.parameters[n]
                    for n in (*names, "seeds", "iterations")
                    if n in loop.parameters
                },
                "environment": self._environment,
                "environments": 0 if shown is None else shown.batch,
                "rounds": round(loop.rounds.per_second(now), 2),
                "episodes": round(loop.episodes.per_second(now), 2),
                "nodes": loop.health.told(now),
                "controls": loop.controls,
                "paused": self._paused(),
            }
            text = json.dumps(status).encode()
            if text != self._status:
                self._status = text
                self._versions["status"] += 1
            if shown is not None and now - self._ranged > FRESH:
                self._ranged = now
                self._set_range(shown)

    def updates(self, cursor: Cursor) -> list[bytes]:
        """What is new since `cursor`, which moves on: JSON, or JSON and float32 numbers (`pack`)."""
        with self._lock:
            loop, versions, found = self._loop, self._versions, []
            if cursor.status != versions["status"]:
                cursor.status = versions["status"]
                found.append(self._status)
            if cursor.curve != (id(loop.curve), loop.curve.version).__hash__():
                cursor.curve = (id(loop.curve), loop.curve.version).__hash__()
                found.append(json.dumps({"part": "curve", **loop.curve.told()}).encode())
            if loop.shown is None:
                return found
            if cursor.target != versions["target"] or cursor.begun != versions["begun"]:
                cursor.target = versions["target"]
                found.append(self._target(loop.shown))
            sample = self._sample(loop.shown, cursor)
            return [*found, sample] if sample else found

    def _target(self, shown: Episode) -> bytes:
        values = self._loop.targets.get(shown.key[2])
        if values is None:
            return pack({"part": "target"}, np.empty(0, np.float32))
        return pack({"part": "target"}, values[rows_of(len(values))].astype(np.float32))

    def _sample(self, shown: Episode, cursor: Cursor) -> bytes | None:
        now = (shown.samples, shown.last, shown.ended)
        same = (
            cursor.begun == self._versions["begun"]
            and cursor.environment == self._environment
            and cursor.stride == shown.stride
        )
        if same and cursor.shown == now:
            return None
        row = shown.row(self._environment)
        first = cursor.column if same else 0
        cursor.begun, cursor.environment = self._versions["begun"], self._environment
        cursor.stride, cursor.column, cursor.shown = shown.stride, shown.settled, now
        fields = shown.fields[row, first : shown.columns]
        actions = shown.actions[row, first : shown.columns] if shown.actions.size else None
        header = {
            "part": "episode",
            "new": not same,
            "run": shown.key[0],
            "episode": shown.key[1],
            "kind": self._loop.kinds.get(shown.key[:2], ""),
            "environment": shown.environments[row],
            "first": first,
            "columns": len(fields),
            "rows": fields.shape[1],
            "actions": 0 if actions is None else actions.shape[1],
            "stride": shown.stride,
            "begin": shown.first,
            "last": shown.last,
            "ended": shown.ended,
            "sample_time": shown.sample_time or self._loop.parameters.get("sample_time", 0.0),
            "time": shown.time,
            "range": self._range,
        }
        latest = shown.latest[row][rows_of(shown.latest.shape[1])]
        parts = [fields, *([] if actions is None else [actions]), latest]
        return pack(header, np.concatenate([part.ravel() for part in parts]))

    def _wanted(self, frame: Frame, now: float, role: str) -> bool:
        if self._only is not None and frame.run != self._only:
            return False
        loop = self._loop
        loop.health.heard(now, role)
        loop.heard, loop.run = now, frame.run
        return True

    def _join(self, now: float) -> None:
        """Show an episode of which the beginning was seen, or any if there is no better for long."""
        loop = self._loop
        if loop.pending is not None and (
            loop.pending.whole or loop.shown is None or now - loop.pending_since > JOIN
        ):
            loop.shown, loop.pending = loop.pending, None
            self._versions["begun"] += 1

    def _count(self, key: Key, step: int, now: float) -> None:
        """Count rounds, of which not every one was seen: an episode's last step says how many."""
        loop = self._loop
        before = loop.counted[1] if loop.counted and loop.counted[0] == key else 0
        if step > before:
            loop.rounds.add(step - before, now)
            plant = loop.health.peers["plant"].name
            if now - loop.paused.get(plant, now) > SILENT:  # somebody else resumed it
                del loop.paused[plant]
        loop.counted = key, max(step, before)

    def _set_range(self, shown: Episode) -> None:
        seen = shown.fields[shown.row(self._environment), : shown.columns]
        seen = seen[np.isfinite(seen)]
        if not seen.size:
            return
        low, high = (
            float(v) for v in np.percentile(seen[:: max(1, seen.size // 20_000)], EXTREMES)
        )
        target = self._loop.targets.get(shown.key[2])
        if target is not None:
            low, high = min(low, float(target.min())), max(high, float(target.max()))
        if high - low < 1e-9:
            low, high = low - 0.5, high + 0.5
        old_low, old_high = self._range
        size = max(high - low, old_high - old_low)
        if abs(low - old_low) > 0.15 * size or abs(high - old_high) > 0.15 * size:
            self._range = low, high  # small changes would only make the colours flicker

    def _paused(self) -> list[str]:
        """The roles of the nodes that somebody holds."""
        loop, found = self._loop, []
        for role in ("plant", "tuner"):
            name = loop.health.peers[role].name
            told = loop.health.value(role, "paused", since=loop.answered.get(name, 0.0))
            held = loop.plant_paused and role == "plant"
            if held or name in loop.paused or told == "yes":
                found.append(role)
        return found

    def _state(self, now: float) -> str:
        loop = self._loop
        if self._place.get("domain") is None:
            return "searching"
        if loop.ended:
            return "ended"
        if not any(peer.present for peer in loop.health.peers.values()):
            return "empty"
        if self._paused():
            return "paused"
        if loop.heard is None:
            return "waiting"
        return "running" if now - loop.heard < SILENT else "silent"


def pack(header: Mapping[str, Any], values: NDArray[np.float32]) -> bytes:
    """Length of the header (uint32), the header as JSON padded to 4 bytes, numbers; little-endian."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return _LENGTH.pack(len(text)) + text + values.astype("<f4").tobytes()
