# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Progress display: a live bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

PERIOD = 5.0
"""Seconds without a line, where there is no terminal, after which the next news is one."""


class Progress:
    """Shows how much of a task is done; title, unit: a word for the task, and for what is counted.

    On a terminal a bar, which leaves no trace. Elsewhere a line for every tenth of the work, and
    for the first news after some seconds without one; what was already printed is not news.
    """

    def __init__(self, console: Console, title: str, unit: str) -> None:
        self._console, self._title, self._unit = console, title, unit
        self._bar = Bar(
            TextColumn(title),
            BarColumn(),
            TextColumn("{task.fields[amount]}"),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
        )
        self._task = self._bar.add_task("", amount="", status="")
        self._tenths, self._told, self._printed_at = -1, "", time.monotonic()

    def tell(self, done: int, total: int, status: str = "") -> None:
        """Now `done` of `total` are done; status: a few words on what was done last."""
        amount = f"{done} of {total} {self._unit}"
        if self._console.is_terminal:
            self._bar.start()
            self._bar.update(self._task, completed=done, total=total, amount=amount, status=status)
            return
        tenths, now = 10 * done // total, time.monotonic()
        words = f"{self._title}: {amount}" + (f", {status}" if status else "")
        first = self._tenths < 0
        due = tenths > self._tenths or now - self._printed_at > PERIOD
        if done < total and not first and due and words != self._told:
            self._told, self._printed_at = words, now
            self._console.print(words, markup=False)
        self._tenths = tenths

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._console.is_terminal:
            self._bar.stop()
