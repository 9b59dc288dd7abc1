# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a web page is sent: the status, the learning curve, the target and the shown episode. Pure.

A message is JSON text. One with numbers is binary, little-endian: the length of the header (uint32),
the header as JSON padded to 4 bytes, then float32 numbers.

One thread feeds the view, another one sends what is new; both hold `Page.lock` meanwhile. `now` is
any monotonic time in s.
"""

from __future__ import annotations

import contextlib
import json
import queue
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.grid import Grid
from viewer_node.episode_samples import MAX_COMPONENTS, EpisodeSamples, rows_of
from viewer_node.loop_view import SILENT, LoopView
from viewer_node.operation import Call

RATE_WINDOW = 3.0
"""Seconds over which rates are taken."""
COLOUR_PERIOD = 0.5
"""Seconds between two computations of the range of the colours."""
PARAMETERS = ("problem", "length", "n_a", "horizon", "sample_time")
"""Parameters that the page needs."""


@dataclass(frozen=True)
class ShowLoop:
    """A request to show the loop in this namespace of the domain."""

    namespace: str


class Page:
    """The content of all web pages of a monitor, and what they ask for.

    view: the loop that is shown; place: its ROS domain, folder and namespace, the namespaces that
    there are, and a number that differs from loop to loop; parameters, controls: of its nodes, the
    latter the services that they offer; requests: what the pages ask for, for the thread that feeds
    the view; open: whether a browser shows the page.
    """

    def __init__(self, environment: int = 0) -> None:
        self.lock = threading.RLock()
        self.view = LoopView()
        self.view.environment = environment
        self.place: dict[str, Any] = {"domain": None, "namespaces": [], "begun": 0}
        self.parameters: dict[str, Any] = {}
        self.controls: list[dict[str, Any]] = []
        self.component = 0
        self.requests: queue.SimpleQueue[Call | ShowLoop] = queue.SimpleQueue()
        self.open = False
        self._status: str | None = None
        self._colours = (0.0, 1.0)
        self._coloured = float("-inf")
        self._counts: deque[tuple[float, int, int]] = deque()
        """Time, rounds and episodes of the last RATE_WINDOW."""

    def show(
        self,
        view: LoopView,
        *,
        domain: int | None = None,
        folder: str | None = None,
        namespace: str | None = None,
    ) -> None:
        """Show another loop, in the environment that was chosen."""
        with self.lock:
            view.environment = self.view.environment
            self.view = view
            self.parameters, self.controls = {}, []
            self._counts.clear()
            self.place = {
                "domain": domain,
                "folder": folder,
                "namespace": namespace,
                "namespaces": [],
                "begun": self.place["begun"] + 1,
            }

    def take_parameters(self, values: Mapping[str, Any]) -> None:
        """Take parameters of a node."""
        self.parameters |= {name: values[name] for name in PARAMETERS if name in values}
        if values.get("grid"):
            with contextlib.suppress(ValueError):
                axes = Grid.parse(str(values["grid"])).axes
                if len(axes) != 1:  # the rows of a picture are numbers of the state, not places
                    self.parameters["length"] = 0.0
        self.view.horizon = int(self.parameters.get("horizon", 0))

    def request_call(self, node: object, verb: object) -> bool:
        """Ask for a call of the service `verb` of `node`; False if the loop has none."""
        with self.lock:
            offered = any(c["node"] == node and verb in c["verbs"] for c in self.controls)
        if offered:
            self.requests.put(Call(str(node), str(verb)))
        return offered

    def choose(self, wanted: Mapping[str, Any]) -> bool:
        """Show another component or namespace, if there is one."""
        with self.lock:
            match wanted:
                case {"component": int(index)} if 0 <= index < MAX_COMPONENTS:
                    self.component = int(index)
                case {"namespace": str(name)} if name in self.place["namespaces"]:
                    self.requests.put(ShowLoop(name))
                case _:
                    return False
            self._coloured = float("-inf")
            return True

    def refresh(self, now: float) -> None:
        """Compile the status again; call it every half second or so."""
        with self.lock:
            view, names = self.view, self.view.components[:MAX_COMPONENTS]
            quiet, remaining = view.quiet(now), view.curve.remaining(time.time())
            self._counts.append((now, view.rounds, view.episodes))
            while now - self._counts[0][0] > RATE_WINDOW:
                self._counts.popleft()
            since, rounds, episodes = self._counts[0]
            elapsed = max(now - since, RATE_WINDOW / 10)
            status = {
                "part": "status",
                "place": self.place,
                "state": self._state(now),
                "paused": view.operation.paused(now),
                "stopping": view.operation.stopping,
                "requests": view.operation.requests(now),
                "activity": view.nodes.activity(now),
                "quiet": None if quiet is None or quiet < SILENT else round(quiet),
                "remaining": None if remaining is None else round(remaining),
                "parameters": self.parameters,
                "component": min(self.component, len(names) - 1),
                "components": names,
                "rounds": round((view.rounds - rounds) / elapsed, 2),
                "episodes": round((view.episodes - episodes) / elapsed, 2),
                "nodes": view.nodes.message(now),
                "controls": self.controls,
            }
            self._status = json.dumps(status)
            if now - self._coloured > COLOUR_PERIOD:
                self._coloured = now
                self._colours = view.colours(self.component, self._colours, now)

    def updates(self, sent: dict[str, object], now: float) -> list[str | bytes]:
        """The messages that are new to a page.

        sent: the version of each part that the page has; it is brought up to date.
        """
        with self.lock:
            new = []
            for part, version, message in self._messages(now):
                if sent.get(part) != version:
                    sent[part] = version
                    new.append(message())
            return new

    def _messages(self, now: float) -> Iterator[tuple[str, object, Callable[[], str | bytes]]]:
        """Name, version and content of every part."""
        view, curve, shown = self.view, self.view.curve, self.view.shown(now)
        yield "status", self._status, lambda: str(self._status)
        yield "curve", curve.version, lambda: json.dumps({"part": "curve", **curve.message()})
        if shown is None:
            return
        target = view.target_of(shown.key)
        chosen = (self.place["begun"], shown.components, self.component)
        yield "target", (*chosen, id(target)), partial(self._target, target, shown)
        samples = (*chosen, shown.version, shown.ended, self._colours)
        yield "episode", samples, partial(self._episode, shown)

    def _target(self, target: NDArray[np.float64] | None, shown: EpisodeSamples) -> bytes:
        """z_r at the kept grid points of the shown component; no numbers if it is not known."""
        z_r = np.empty(0) if target is None else self._points(target, shown)
        return _pack({"part": "target"}, z_r)

    def _episode(self, shown: EpisodeSamples) -> bytes:
        """The shown episode: its field (columns, rows), actions (columns, n_a), newest state (rows)."""
        fields = shown.fields[: shown.columns, shown.part(self.component)]
        actions = shown.actions[: shown.columns]
        header = {
            "part": "episode",
            "run": shown.key[0],
            "episode": shown.key[1],
            "controller": self.view.controller(shown),
            "environment": shown.environment,
            "columns": len(fields),
            "rows": fields.shape[1],
            "actions": actions.shape[1],
            "stride": shown.stride,
            "begin": shown.first,
            "last": shown.last,
            "ended": shown.ended,
            "sample_time": shown.sample_time or self.parameters.get("sample_time", 0.0),
            "range": self._colours,
        }
        newest = self._points(shown.z, shown)
        return _pack(header, np.concatenate([fields.ravel(), actions.ravel(), newest]))

    def _points(self, z: NDArray[np.float64], shown: EpisodeSamples) -> NDArray[np.float64]:
        """A state at the kept grid points of the shown component."""
        return z[rows_of(len(z), shown.components)[shown.part(self.component)]]

    def _state(self, now: float) -> str:
        return "searching" if self.place["domain"] is None else self.view.state_of_loop(now)


def _pack(header: Mapping[str, Any], values: NDArray[np.floating]) -> bytes:
    """A message with numbers."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<I", len(text)) + text + values.astype("<f4").tobytes()
