"""A run that does not run, on the page: curve and seeds from its folder, episodes from its bag.

Needs no ROS: what was on the topics is in the bag.
"""

from __future__ import annotations

import queue
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pdeloop.display import ProgressFile
from pdeloop.monitor.finder import Finder, run_id
from pdeloop.monitor.names import component_names, short
from tuner_node.results import RunFolder
from viewer_node.loop_view import LoopView
from viewer_node.web.page import Page, Recorded, ShowEpisode

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
        self._bag = _RecordedEpisodes(folder)
        self._recorded = Recorded(
            finished=(folder / "result.json").is_file(),
            episodes=len(self._bag.rows),
            note=self._bag.note,
        )
        with page.lock:
            page.show(self._view, folder=short(folder), recorded=self._recorded)
            page.take_parameters(values)
        page.refresh(time.monotonic())  # before the bag is read, which may take seconds
        if self._bag.rows:
            self.show(len(self._bag.rows) - 1)

    def show(self, index: int) -> None:
        """Show the recorded episode of this index, from its newest state."""
        episode, view, now = self._bag.read(index), self._view, time.monotonic()
        with self._page.lock:
            view.current = view.finished = None
            if episode is not None:
                known = (episode.bases, episode.policy, episode.start)
                for frame, take in zip(known, (view.model, view.policy, view.start), strict=True):
                    if frame is not None:
                        take(frame, now)
                for step, frame in sorted(episode.states.items()):
                    if self._bag.target is not None:
                        view.targets[frame.plant] = self._bag.target
                    view.state(frame, now)
                    if step in episode.actions:
                        view.action(episode.actions[step], now)
                if episode.cost is not None:
                    view.cost(episode.cost, now)
            self._recorded.chosen = index
            self._recorded.label = self._bag.label(index)
        self._page.refresh(now)


class _RecordedEpisodes:
    """The episodes in the bag of a run; without rows and with a note if there are none.

    rows: of the recorder's index.
    """

    def __init__(self, folder: Path) -> None:
        self.rows: list[Mapping[str, Any]] = []
        self.target, self.note = None, ""
        try:
            from pdeloop.bags.reader import Bag
            from recorder_node.bag import BagError
        except ModuleNotFoundError as error:
            self.note = f"Its episodes need {error.name}: pip install 'pdeloop[record]'"
            return
        try:
            self._bag = Bag(folder)
            self.rows = [row for row in self._bag.index() if "episode" in row]
            self.target = self._bag.target()
        except BagError:
            self.note = "The episodes of this run were not recorded (pdeloop train --record)."

    def read(self, index: int) -> Any:
        """The recorded episode, None if the bag lacks it."""
        row = self.rows[index]
        found = self._bag.find(int(row["episode"]))
        return next((e for e in found if e.key[0] == row.get("namespace", e.key[0])), None)

    def label(self, index: int) -> str:
        """The episode in words."""
        row = self.rows[index]
        words = [f"episode {int(row['episode']) % 2**32}"]
        words += ["exploration"] if row.get("exploratory") else []
        words += [f"{row['environments']} environments"] if row.get("environments") else []
        words += [str(row["namespace"])] if row.get("namespace", "/") != "/" else []
        words += [f"incomplete: {', '.join(row['missing'])}"] if row.get("missing") else []
        return ", ".join(words)


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
