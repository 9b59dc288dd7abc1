"""What a page is sent: the status, the learning curve, and the new samples of the shown episode.

One thread feeds the view, another takes out what a page does not have yet; both hold `Page.lock`
meanwhile. `now` is any monotonic time in s.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from viewer_node.episode_samples import MAX_COMPONENTS
from viewer_node.loop_view import SILENT, LoopView
from viewer_node.web.messages import Cursor, samples_message, target_message

FRESH = 0.5
"""Seconds between two looks at the range of the colours."""
PARAMETERS = (
    *("problem", "length", "n_z", "n_a", "horizon", "sample_time"),
    *("optimizer", "seeds"),
)
"""Parameters that the page shows or needs."""


@dataclass
class Recorded:
    """A run that does not run: whether it came to its end, how many episodes of it were recorded, the
    one that is shown; note: why there are none.
    """

    finished: bool
    episodes: int = 0
    chosen: int = 0
    label: str = ""
    note: str = ""


class Page:
    """What all pages of a monitor are sent.

    view: of the loop that is shown; place: its domain, folder, namespace and namespaces, for people;
    parameters, controls: of its nodes, and the services that they offer; recorded: if it is a run that
    does not run.
    """

    def __init__(self, environment: int = 0) -> None:
        self.lock = threading.RLock()
        self.view = LoopView()
        self.view.environment = environment
        self.place: dict[str, Any] = {"domain": None, "folder": None, "namespace": None}
        self.parameters: dict[str, Any] = {}
        self.controls: list[dict[str, Any]] = []
        self.recorded: Recorded | None = None
        self.component = 0
        self._generation = 0
        self._status = b"{}"
        self._status_version = -1
        self._colours = (0.0, 1.0)
        self._coloured = float("-inf")

    def show(
        self, view: LoopView, place: Mapping[str, Any], recorded: Recorded | None = None
    ) -> None:
        """Show another loop, in the environment that was chosen."""
        with self.lock:
            view.environment = self.view.environment
            self.view, self.recorded = view, recorded
            self._generation += 1
            self.place = {**place, "begun": self._generation}
            self.parameters, self.controls = {}, []

    def take_parameters(self, values: Mapping[str, Any]) -> None:
        """Take parameters of a node."""
        self.parameters |= {name: values[name] for name in PARAMETERS if name in values}
        self.view.horizon = int(self.parameters.get("horizon", 0))

    def choose(self, *, environment: int | None = None, component: int | None = None) -> None:
        """Show another environment, or another component of the state."""
        with self.lock:
            if environment is not None:
                self.view.environment = environment
            self.component = self.component if component is None else component
            self._coloured = float("-inf")

    def offers(self, node: str, verb: object) -> bool:
        """Whether `node` is one of this loop's and has the service `verb`."""
        with self.lock:
            return any(c["node"] == node and verb in c["verbs"] for c in self.controls)

    def has_episode(self, index: int) -> bool:
        """Whether there is a recorded episode of this index."""
        with self.lock:
            return self.recorded is not None and 0 <= index < self.recorded.episodes

    def known_namespaces(self) -> list[str]:
        """The loops in this domain, by namespace."""
        with self.lock:
            return list(self.place.get("namespaces") or [])

    def refresh(self, now: float) -> None:
        """Put the status together again; call it now and then."""
        with self.lock:
            view, names = self.view, self.view.components[:MAX_COMPONENTS]
            quiet, remaining = view.quiet(now), view.curve.remaining(time.time())
            shown = view.shown(now)
            status = {
                "part": "status",
                "place": self.place,
                "state": self._state(now),
                "paused": view.operation.paused(),
                "stopping": view.operation.stopping,
                "requests": view.operation.requests(now),
                "activity": view.nodes.activity(now),
                "quiet": None if quiet is None or quiet < SILENT else round(quiet),
                "remaining": None if remaining is None else round(remaining),
                "parameters": self.parameters,
                "environment": view.environment,
                "environments": 0 if shown is None else shown.batch,
                "component": min(self.component, len(names) - 1),
                "components": names,
                "rounds": round(view.rounds.per_second(now), 2),
                "episodes": round(view.episodes.per_second(now), 2),
                "nodes": view.nodes.message(now),
                "controls": self.controls,
                "recorded": None if self.recorded is None else vars(self.recorded),
            }
            text = json.dumps(status).encode()
            if text != self._status:
                self._status = text
                self._status_version += 1
            if now - self._coloured > FRESH:
                self._coloured = now
                self._colours = view.colours(self.component, self._colours, now)

    def updates(self, cursor: Cursor, now: float) -> list[bytes]:
        """The messages with what is new since `cursor`, which moves on."""
        with self.lock:
            view, found = self.view, []
            if cursor.status != self._status_version:
                cursor.status = self._status_version
                found.append(self._status)
            curve = (view.curve.number, view.curve.version)
            if cursor.curve != curve:
                cursor.curve = curve
                found.append(json.dumps({"part": "curve", **view.curve.message()}).encode())
            shown = view.shown(now)
            if shown is None:
                return found
            target = view.targets.get(shown.key[2])
            aim = (shown.number, id(target), self.component)
            if cursor.target != aim:
                cursor.target = aim
                found.append(target_message(target, shown, self.component))
            message = samples_message(
                shown,
                cursor,
                controller=partial(view.controller, shown),
                environment=view.environment,
                component=self.component,
                colours=self._colours,
                sample_time=shown.sample_time or self.parameters.get("sample_time", 0.0),
            )
            return [*found, message] if message else found

    def _state(self, now: float) -> str:
        if self.recorded is not None:
            return "recorded"
        return "searching" if self.place["domain"] is None else self.view.state_of_loop(now)
