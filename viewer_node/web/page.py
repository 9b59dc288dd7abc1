# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The messages to a web page: the status, the learning curve, the target and the shown episode. Pure.

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

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.actuators import parse
from pdeloop.messages.frames import Frame
from pdeloop.messages.grid import Axis, Grid
from viewer_node.episode_samples import MAX_COMPONENTS, EpisodeSamples
from viewer_node.loop_nodes import Call
from viewer_node.loop_view import SILENT, LoopView, path_of

RATE_WINDOW = 3.0
"""Seconds over which rates are taken."""
COLOUR_PERIOD = 0.5
"""Seconds between two computations of the range of the colours."""
PARAMETERS = ("problem", "n_a", "sample_time")
"""Parameters that the page takes from any node."""
OF_PLANT = (
    "grid", "length", "sensors", "actuators", "horizon", "n_a", "action_limit", "action_bounds", "cost",
)  # fmt: skip
"""Those that it takes from a plant alone: other nodes have mere defaults of one that tells none."""
MOST_PANELS = 4
"""Components shown side by side; of more, one is chosen."""
Axes = list[dict[str, Any]]
Range = tuple[float, float]


def axes_of(values: Mapping[str, Any]) -> Axes:
    """The axes of a picture from a plant's parameters: label, length and where the points lie.

    One of a field on one axis or of numbers, the last two of a field on more.
    """
    sensors = int(values.get("sensors") or 0)
    try:
        grid = Grid.parse(str(values["grid"]))
    except (KeyError, ValueError):
        if sensors:
            return [_axis("sensor")]
        length = float(values.get("length") or 0.0)
        return [_axis("x (m)", length)] if length > 0 else [_axis("grid point")]
    if sensors and (len(grid.axes) != 1 or sensors > grid.points):
        return [_axis("sensor")]
    told = [_axis(axis.label, axis.length, _ends(axis)) for axis in grid.axes[-2:]]
    if sensors:  # they are at the points of Grid.equally_spaced
        first, spacing, n = told[0]["ends"][0], grid.axes[0].spacing, grid.points
        ends = (n // (2 * sensors), (2 * sensors - 1) * n // (2 * sensors))
        told[0]["ends"] = [first + i * spacing for i in ends]
    return told or [_axis("number")]


def _ends(axis: Axis) -> list[float]:
    """Places of its first and last point; of an axis that was received, however long."""
    first = 0.0 if axis.periodic or axis.walls else 0.5 * axis.spacing
    return [first, first + (axis.size - 1) * axis.spacing]


def _axis(label: str, length: float = 0.0, ends: list[float] | None = None) -> dict[str, Any]:
    """An axis; length 0: it counts.

    ends: places of the first and last point; None: one spacing before the end, as on a ring.
    """
    return {"label": label, "length": length, "ends": ends}


def places_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Positions of actuators and sensors, from a plant's parameters."""
    try:
        grid = Grid.parse(str(values["grid"]))
        boxes = parse(str(values.get("actuators") or "[]"))
    except (KeyError, ValueError):
        return {"actuators": [], "sensors": 0}
    dimensions = max(1, len(grid.axes))
    fitting = [box for box in boxes if len(box.sides) == dimensions]
    told = [{"component": box.component, "sides": box.sides[-2:]} for box in fitting]
    sensors = int(values.get("sensors") or 0)
    return {"actuators": [] if sensors and dimensions > 1 else told, "sensors": sensors}


def bounds_of(values: Mapping[str, Any]) -> dict[str, list[float | None]] | None:
    """Bounds of each actuator from a plant's parameters, None where it has none; None without any.

    Examples
    --------
    >>> bounds_of({"n_a": 2, "action_bounds": [0.0, 0.0, 4.0, 1e300, 0.0]})
    {'low': [0.0, 0.0], 'high': [4.0, None]}
    """
    try:
        known = ActionSet.of({"n_a": int(values["n_a"]), "action_limit": 0.0, **values})
    except (KeyError, TypeError, ValueError):
        return None
    low, high = (np.broadcast_to(part, int(values["n_a"])) for part in (known.low, known.high))
    if not np.isfinite([low, high]).any():
        return None
    told = {"low": low.tolist(), "high": high.tolist()}
    return {name: [b if np.isfinite(b) else None for b in part] for name, part in told.items()}


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
        self._of_plant: dict[str, Any] = {}
        """Its parameters that say where things are."""
        self._colours: dict[int, Range] = {}
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
            self.parameters, self.controls, self._of_plant = {}, [], {}
            self._colours, self._coloured = {}, float("-inf")
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
        if "actuators" not in values:  # which a plant declares, and no other node
            return
        self._of_plant |= {name: values[name] for name in OF_PLANT if values.get(name)}
        with contextlib.suppress(TypeError, ValueError):
            self.parameters["axes"] = axes_of(self._of_plant)
            self.parameters["places"] = places_of(self._of_plant)
            self.view.grid = Grid.parse(str(self._of_plant.get("grid")))
        self.parameters["bounds"] = bounds_of(self._of_plant)
        path = path_of(self._of_plant)
        path = np.empty((0, 0)) if path is None else path
        if not np.array_equal(path, self.view.path):
            self.view.path = path
        self.parameters["horizon"] = self.view.horizon = int(self._of_plant.get("horizon", 0))

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
            searching = self.place["domain"] is None
            status = {
                "part": "status",
                "place": self.place,
                "state": "searching" if searching else view.state_of_loop(now),
                "paused": view.operation.paused(now),
                "stopping": view.operation.stopping,
                "requests": view.operation.requests(now),
                "activity": view.nodes.activity(now),
                "quiet": None if quiet is None or quiet < SILENT else round(quiet),
                "remaining": None if remaining is None else round(remaining),
                "parameters": self.parameters,
                "panels": self._panels(),
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
                for i in self._panels():
                    self._colours[i] = view.colours(i, self._colours.get(i, (0.0, 1.0)), now)

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
        panels = self._panels()
        if shown is None:  # the target is latched: it is there before the first episode is
            target = view.newest_target()
            if target is not None and panels:
                shown = EpisodeSamples(
                    Frame(0, 0, 0, 0.0, target[np.newaxis], 0),
                    components=len(view.components),
                    grid=view.grid,
                )
                version = (self.place["begun"], *panels, id(target), view.grid)
                yield "target", version, partial(self._target, target, shown)
            return
        target = view.target_of(shown.key)
        chosen = (self.place["begun"], shown.components, shown.plane, *panels)
        known: tuple[object, ...] = (*chosen, id(target))
        if (moving := view.path_at(shown)) is not None:
            target = moving
            known = (*chosen, id(view.path), shown.last)
            path = (*chosen, id(view.path), shown.first, shown.stride)
            yield "path", path, partial(self._moving, shown)
        yield "target", known, partial(self._target, target, shown)
        ranges = tuple(self._colours.get(i, (0.0, 1.0)) for i in panels)
        samples = (*chosen, shown.version, shown.ended, ranges)
        yield "episode", samples, partial(self._episode, shown)

    def _panels(self) -> list[int]:
        count = min(len(self.view.components), MAX_COMPONENTS)
        return list(range(count)) if count <= MOST_PANELS else [min(self.component, count - 1)]

    def _of_shown(self, shown: EpisodeSamples) -> list[int]:
        """The panels that the samples have a component for."""
        return [i for i in self._panels() if i < _kept(shown)] or [0]

    def _target(self, target: NDArray[np.float64] | None, shown: EpisodeSamples) -> bytes:
        """z_r as it is drawn, and at the grid points of the columns; no numbers if it is not known."""
        panels = self._of_shown(shown)
        z_r = np.empty(0)
        if target is not None and target.size == shown.z.size:
            rows = target[shown.rows]
            z_r = np.concatenate(
                [shown.picture(target, i) for i in panels] + [rows[shown.part(i)] for i in panels]
            )
        header = {"part": "target", "panels": panels, "plane": shown.plane}
        return _pack({**header, "rows": shown.fields.shape[1] // _kept(shown)}, z_r)

    def _moving(self, shown: EpisodeSamples) -> bytes:
        """The target of each column to the horizon, (columns, panels, rows)."""
        panels, last = self._of_shown(shown), len(self.view.path) - 1
        end = max(self.view.horizon, shown.last, 1)
        steps = np.minimum(np.arange(shown.first, end + 1, shown.stride), last)
        rows = self.view.path[:, shown.rows][steps]
        own = np.stack([rows[:, shown.part(i)] for i in panels], axis=1)
        header = {"part": "path", "columns": len(steps), "begin": shown.first}
        return _pack({**header, "stride": shown.stride, "panels": panels}, own.ravel())

    def _episode(self, shown: EpisodeSamples) -> bytes:
        """The shown episode.

        The panels' fields (columns, panels, rows), the actions (columns, n_a), and the panels' newest
        and first state as they are drawn.
        """
        panels = self._of_shown(shown)
        parts = [shown.fields[: shown.columns, shown.part(i)] for i in panels]
        fields, actions = np.concatenate(parts, axis=1), shown.actions[: shown.columns]
        header = {
            "part": "episode",
            "run": shown.key[0],
            "episode": shown.key[1],
            "controller": self.view.controller(shown),
            "environment": shown.environment,
            "panels": panels,
            "plane": shown.plane,
            "columns": shown.columns,
            "rows": parts[0].shape[1],
            "actions": actions.shape[1],
            "stride": shown.stride,
            "begin": shown.first,
            "last": shown.last,
            "ended": shown.ended,
            "sample_time": shown.sample_time or self.parameters.get("sample_time", 0.0),
            "ranges": [self._colours.get(i, (0.0, 1.0)) for i in panels],
        }
        drawn = [shown.picture(z, i) for z in (shown.z, shown.z_first) for i in panels]
        return _pack(header, np.concatenate([fields.ravel(), actions.ravel(), *drawn]))


def _kept(shown: EpisodeSamples) -> int:
    """Components of which there are samples."""
    return min(shown.components, MAX_COMPONENTS)


def _pack(header: Mapping[str, Any], values: NDArray[np.floating]) -> bytes:
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<I", len(text)) + text + values.astype("<f4").tobytes()
