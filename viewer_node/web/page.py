"""What the page is told: everything the monitor knows of the loop it watches. Pure.

One thread puts in what comes from the topics, another takes out what a page does not have yet; each
method holds the lock for as long as it runs, which is short. `now` is any monotonic time in s.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from loop_interfaces.frames import Frame
from viewer_node.episode_samples import COMPONENTS
from viewer_node.learning_curve import LearningCurve
from viewer_node.loop_nodes import Endpoint
from viewer_node.loop_view import SILENT, Watched
from viewer_node.web.messages import Cursor, sample, target
from viewer_node.web.requests import Call

FRESH = 0.5
"""Seconds between two looks at the range of the colours."""
_PARAMETERS = (
    *("problem", "length", "n_z", "n_a", "horizon", "sample_time"),
    *("optimizer", "seeds"),
)
"""Parameters that the page shows or needs."""


class View:
    """All of it, for the monitor's life.

    environment: index in the batch that is shown.
    """

    def __init__(self, environment: int = 0) -> None:
        self._lock = threading.Lock()
        self._watched = Watched()
        self._generation = 0
        self._place: dict[str, Any] = {"domain": None, "folder": None, "namespace": None}
        self._environment, self._component = environment, 0
        self._status = b"{}"
        self._status_version = -1
        self._colours = (0.0, 1.0)
        self._coloured = float("-inf")

    def watch(self, place: Mapping[str, Any], *, run: int | None, from_topics: bool) -> None:
        """Begin with another loop.

        place: domain, folder, namespace and namespaces of it, for people; run: the only one to
        show; from_topics: whether the curve comes from the costs on the topics.
        """
        with self._lock:
            self._watched = Watched(only=run, from_topics=from_topics)
            self._generation += 1
            self._place = {**place, "begun": self._generation}

    # From the topics.

    def state(self, frame: Frame, now: float) -> None:
        """Take z_k of all environments."""
        with self._lock:
            self._watched.state(frame, now, self._environment)

    def action(self, frame: Frame, now: float) -> None:
        """Take a_k of all environments."""
        with self._lock:
            self._watched.action(frame, now)

    def start(self, frame: Frame, now: float) -> None:
        """Take the start of an episode; without rows it is the end of the run."""
        with self._lock:
            self._watched.start(frame, now)

    def policy(self, frame: Frame, now: float) -> None:
        """Take the gains of an episode."""
        with self._lock:
            self._watched.policy(frame, now)

    def cost(self, frame: Frame, now: float) -> None:
        """Take the costs of an episode that is over."""
        with self._lock:
            self._watched.cost(frame, now)

    def target(self, frame: Frame, now: float) -> None:
        """Take z_r of a plant."""
        with self._lock:
            self._watched.target(frame, now)

    def paused(self, frame: Frame, now: float) -> None:
        """Take whether an operator holds the plant."""
        with self._lock:
            self._watched.paused(frame, now)

    def diagnosis(
        self, name: str, level: int, message: str, values: Iterable[tuple[str, str]], now: float
    ) -> None:
        """Take a status from /diagnostics."""
        with self._lock:
            self._watched.health.diagnosis(name, level, message, values, now)

    # From the graph, the services and the run's folder.

    def namespaces(self, found: list[str]) -> None:
        """The loops in this domain, by namespace."""
        with self._lock:
            self._place["namespaces"] = found

    def look(self, found: Mapping[str, Iterable[Endpoint]], controls: list[dict[str, Any]]) -> None:
        """Take who publishes what, by role, and which nodes offer which services."""
        with self._lock:
            self._watched.health.look(found)
            self._watched.controls = controls

    def parameters(self, values: Mapping[str, Any]) -> None:
        """Take parameters that a node told."""
        with self._lock:
            self._watched.parameters |= {k: values[k] for k in _PARAMETERS if k in values}

    def components(self, names: Sequence[str]) -> None:
        """Take the names of the components that make up a state, one after the other."""
        with self._lock:
            self._watched.components = list(names) or ["u"]

    def follow(self, folder: str) -> None:
        """The curve comes from the lines of the run in `folder` from now on (`progress`)."""
        with self._lock:
            self._place["folder"], self._watched.from_topics = folder, False
            self._watched.curve = LearningCurve()

    def progress(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Take new lines of the run's progress.jsonl."""
        with self._lock:
            for row in rows:
                self._watched.curve.row(row)

    def asked(self, call: Call, now: float) -> None:
        """A page asks a node for something."""
        with self._lock:
            self._watched.asked(call, now)
        self.refresh(now)

    def answered(self, call: Call, now: float, failure: str | None) -> None:
        """A node did what it was asked to, or not: then why."""
        with self._lock:
            self._watched.answered(call, now, failure)
        self.refresh(now)

    @property
    def run(self) -> int:
        """The run of the newest message; 0 before the first."""
        with self._lock:
            return self._watched.run

    @property
    def complete(self) -> bool:
        """Whether the episode that is shown is over, and was seen from its beginning."""
        with self._lock:
            shown = self._watched.shown
            return shown is not None and shown.ended and shown.whole

    # From and to the page.

    def choose(self, *, environment: int | None = None, component: int | None = None) -> None:
        """Show another environment, or another component of the state."""
        with self._lock:
            self._environment = self._environment if environment is None else environment
            self._component = self._component if component is None else component
            self._coloured = float("-inf")

    def offers(self, node: str, verb: object) -> bool:
        """Whether `node` is one of this loop's and has the service `verb`."""
        with self._lock:
            return any(c["node"] == node and verb in c["verbs"] for c in self._watched.controls)

    def known_namespaces(self) -> list[str]:
        """The loops in this domain, by namespace."""
        with self._lock:
            return list(self._place.get("namespaces") or [])

    def refresh(self, now: float) -> None:
        """Put the status together again; call it now and then."""
        with self._lock:
            watched, chosen = self._watched, (self._environment, self._component)
            names = watched.components[:COMPONENTS]
            watched.join(now)
            searching = self._place["domain"] is None
            quiet, remaining = watched.quiet(now), watched.curve.remaining(time.time())
            status = {
                "part": "status",
                "place": self._place,
                "state": "searching" if searching else watched.doing(now),
                "paused": watched.held(),
                "stopping": watched.stopping,
                "requests": watched.requests(now),
                "activity": watched.health.activity(now),
                "quiet": None if quiet is None or quiet < SILENT else round(quiet),
                "remaining": None if remaining is None else round(remaining),
                "parameters": watched.parameters,
                "environment": self._environment,
                "environments": 0 if watched.shown is None else watched.shown.batch,
                "component": min(self._component, len(names) - 1),
                "components": names,
                "rounds": round(watched.rounds.per_second(now), 2),
                "episodes": round(watched.episodes.per_second(now), 2),
                "nodes": watched.health.told(now),
                "controls": watched.controls,
            }
            text = json.dumps(status).encode()
            if text != self._status:
                self._status = text
                self._status_version += 1
            if now - self._coloured > FRESH:
                self._coloured = now
                self._colours = watched.colours(*chosen, self._colours)

    def updates(self, cursor: Cursor) -> list[bytes]:
        """The messages with what is new since `cursor`, which moves on."""
        with self._lock:
            watched, generation, found = self._watched, self._generation, []
            chosen = self._environment, self._component
            if cursor.status != self._status_version:
                cursor.status = self._status_version
                found.append(self._status)
            curve = (watched.curve.number, watched.curve.version)
            if cursor.curve != curve:
                cursor.curve = curve
                found.append(json.dumps({"part": "curve", **watched.curve.message()}).encode())
            if watched.shown is None:
                return found
            aims = (watched.begun, len(watched.targets), self._component)
            if cursor.target != aims or cursor.begun[0] != generation:
                cursor.target = aims
                found.append(target(watched, watched.shown, self._component))
            message = sample(
                watched,
                watched.shown,
                cursor,
                generation=generation,
                chosen=chosen,
                colours=self._colours,
            )
            return [*found, message] if message else found
