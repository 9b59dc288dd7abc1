# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Finds the loop that the monitor shows: the given one, or the training that runs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

from pdeloop.domain import Live, is_locked, running
from pdeloop.messages.files import read_json


class Finder:
    """Finds the loop to show.

    folder: of a run, to show this one only; domain: show this ROS
    domain, whatever runs there. With neither, the newest loop on this machine that runs, and the
    next one when it has ended.
    """

    def __init__(
        self, folder: Path | None, domain: int | None, loops: Callable[[], list[Live]] = running
    ) -> None:
        self._folder = None if folder is None else folder.resolve()
        self._domain = domain
        self._loops = loops
        self._found: Live | None = None

    def find(self) -> Live | None:
        """The loop to show now; None as long as there is none.

        One that has ended stays until there is another.
        """
        running = self._loops()
        if self._folder is not None:
            running = [live for live in running if live.folder == self._folder]
        if self._domain is not None:
            running = [live for live in running if live.domain == self._domain]
            # Nodes that were started by hand announce nothing, but a tuner holds its run's folder.
            if not running and (self._folder is None or worked_on(self._folder)):
                running = [Live(self._domain, self._folder, 0.0)]
        if self._found not in running:
            self._found = running[0] if running else self._found
        return self._found

    @property
    def only_run(self) -> int | None:
        """The run to show, when a folder was given and has one."""
        return None if self._folder is None else run_id(self._folder)


def worked_on(folder: Path) -> bool:
    """True if a process works on the run in `folder` (tuner_node.run_folder.RunFolder.locked)."""
    with contextlib.suppress(OSError), (folder / "lock").open("rb") as file:
        return is_locked(file)
    return False


def run_id(folder: Path) -> int | None:
    """The id of the run in `folder`, None if there is none."""
    with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
        return int(read_json(folder / "run.json")["run"])
    return None
