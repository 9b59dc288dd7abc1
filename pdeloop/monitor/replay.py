"""A run that does not run, on the page: curve and seeds from its folder, episodes from its bag.

Needs no ROS: what was on the topics is in the bag.
"""

from __future__ import annotations

import contextlib
import queue
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from loop_interfaces.frames import Frame
from pde_sim_node.equations import EQUATIONS
from pdeloop.display import ProgressFile
from pdeloop.monitor.finder import Finder, run_id
from tuner_node.results import RunFolder
from viewer_node.loop_view import LoopView
from viewer_node.web.page import Page, Recorded, ShowEpisode

if TYPE_CHECKING:  # both need the extra `record`
    from pdeloop.bags.episodes import Key, RecordedEpisode

REFRESH = 0.5
"""Period (s) of updating rates and progress, and of checking whether a run goes on again."""


class Replay:
    """Shows the run in `folder` on `page`."""

    def __init__(self, folder: Path, page: Page) -> None:
        self._page = page
        self._view = LoopView(only=run_id(folder), curve_from_topics=False)
        progress = ProgressFile(folder / "progress.jsonl", past=True)
        for rows in iter(progress.rows, []):
            for row in rows:
                self._view.curve.row(row)
        values = RunFolder(folder).values()
        self._view.components = component_names(values)
        recorded = Recorded(finished=(folder / "result.json").is_file())
        recorded.note = "Looking for recorded episodes."
        with page.lock:
            page.show(self._view, folder=short(folder), recorded=recorded)
            page.take_parameters(values)
        page.refresh(time.monotonic())  # before the bag is read, which may take seconds
        self._recorded, self._episodes = recorded, list[_Place]()
        self._open(folder)
        recorded.episodes = len(self._episodes)
        if self._episodes:
            recorded.note = ""
            self.show(len(self._episodes) - 1)
        else:
            page.refresh(time.monotonic())

    def _open(self, folder: Path) -> None:
        """Find the episodes in the bag of the run, if it has one."""
        recorded = self._recorded
        try:
            from pdeloop.bags.reader import Bag
            from recorder_node.bag import BagError
        except ModuleNotFoundError as error:
            recorded.note = f"Its episodes need {error.name}: pip install 'pdeloop[record]'"
            return
        recorded.note = "The episodes of this run were not recorded (pdeloop train --record)."
        with contextlib.suppress(BagError):
            self._bag = Bag(folder)
            self._target = self._bag.target()
            for e in self._bag.episodes():
                self._episodes.append(_Place(e.key, e.first, e.last, e.bases, _label(e)))

    def show(self, index: int) -> None:
        """Show the recorded episode of this index, from its newest state."""
        place, view, now = self._episodes[index], self._view, time.monotonic()
        around = self._bag.episodes(place.first, place.last + 1)
        episode = next(e for e in around if e.key == place.key)
        with self._page.lock:
            view.current = view.finished = None
            known = (place.models, episode.policy, episode.start)
            for frame, take in zip(known, (view.model, view.policy, view.start), strict=True):
                if frame is not None:
                    take(frame, now)
            for step, frame in sorted(episode.states.items()):
                if self._target is not None:
                    view.targets[frame.plant] = self._target
                view.state(frame, now)
                if step in episode.actions:
                    view.action(episode.actions[step], now)
            if episode.cost is not None:
                view.cost(episode.cost, now)
            self._recorded.chosen, self._recorded.label = index, place.label
        self._page.refresh(now)


class _Place(NamedTuple):
    """Where a recorded episode is: its first and last time (ns), the models it is about, its words."""

    key: Key
    first: int
    last: int
    models: Frame | None
    label: str


def _label(episode: RecordedEpisode) -> str:
    """An episode in words."""
    words = [f"episode {episode.number % 2**32}"]
    words += ["exploration"] if episode.exploratory else []
    words += [f"{episode.environments} environments"] if episode.environments else []
    words += [episode.key[0]] if episode.key[0] != "/" else []
    words += [f"incomplete: {', '.join(episode.missing)}"] if episode.missing else []
    return ", ".join(words)


def component_names(values: Mapping[str, Any]) -> list[str]:
    """Names of the components that make up a state, from a plant's parameters."""
    if values.get("sensors"):
        count = int(values.get("sensor_delays") or 1)
        return ["y", *(f"y {k} ago" for k in range(1, count))]
    equation = EQUATIONS.get(str(values.get("equation")))
    return ["u"] if equation is None else list(equation.components)


def short(folder: Path) -> str:
    """The folder as a person in the working directory writes it."""
    with contextlib.suppress(ValueError):
        return str(folder.resolve().relative_to(Path.cwd()))
    return str(folder)


def stop_event() -> threading.Event:
    """An event that SIGINT and SIGTERM set from now on."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


def replay(folder: Path, finder: Finder, page: Page) -> bool:
    """Show the run in `folder` until it goes on, or until SIGINT or SIGTERM: then False."""
    stop = stop_event()
    shown = Replay(folder, page)
    while not stop.is_set():
        if finder.find() is not None:
            return True
        try:
            request = page.requests.get(timeout=REFRESH)
        except queue.Empty:
            continue
        if isinstance(request, ShowEpisode):
            shown.show(request.index)
    return False
