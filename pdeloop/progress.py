"""How far something is: a live bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import threading
import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

PERIOD = 5.0
"""Seconds between two lines at the most, where there is no terminal."""


def duration(seconds: float) -> str:
    """Seconds as people say them."""
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    minutes, hours = round(seconds / 60), seconds / 3600
    return f"{minutes} min" if minutes < 100 else f"{hours:.1f} h"


class Progress:
    """Shows how much of a task is done.

    On a terminal a bar, which leaves no trace. Elsewhere a line every tenth and every few seconds,
    also while nothing is told.

    Parameters
    ----------
    console : Console
    title : str
        A word for the task.
    unit : str
        What is counted; "" for a share from 0 to 1.
    period : float
        Seconds between two lines at the most.
    """

    def __init__(
        self, console: Console, title: str, unit: str = "", period: float = PERIOD
    ) -> None:
        self._console, self._title, self._unit, self._period = console, title, unit, period
        self._bar: Bar | None = None
        self._task: Any = None
        self._started_at = self._printed_at = time.monotonic()
        self._first: float | None = None
        self._done, self._total, self._status = 0.0, 1.0, ""
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._repeater: threading.Thread | None = None

    def tell(self, done: float, total: float = 1.0, status: str = "") -> None:
        """Now `done` of `total` are done; status: a few words on what was done last."""
        with self._lock:
            before = self._done
            self._done, self._total, self._status = done, total, status
            if self._first is None:
                self._first = before = done
            if self._console.is_terminal:
                self._draw()
            elif int(10 * done / total) > int(10 * before / total) and done < total:
                self._print()
        if not self._console.is_terminal and self._repeater is None:
            self._repeater = threading.Thread(target=self._repeat, daemon=True)
            self._repeater.start()

    def close(self) -> None:
        """Leave the terminal as it was."""
        self._closed.set()
        if self._repeater is not None:
            self._repeater.join()
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _repeat(self) -> None:
        while not self._closed.wait(self._period / 4):
            with self._lock:
                if time.monotonic() - self._printed_at > self._period:
                    self._print()

    @property
    def _amount(self) -> str:
        if not self._unit:
            return f"{100 * self._done / self._total:.0f} %"
        return f"{self._done:.0f} of {self._total:.0f} {self._unit}"

    def _print(self) -> None:
        now = time.monotonic()
        self._printed_at, gained = now, self._done - (self._first or 0.0)
        left = ""
        if gained > 0:
            left = (
                f"{duration((now - self._started_at) * (self._total - self._done) / gained)} left"
            )
        words = [f"{self._title}: {self._amount}", self._status, left]
        self._console.print(", ".join(word for word in words if word), markup=False)

    def _draw(self) -> None:
        if self._bar is None:
            self._bar = Bar(
                TextColumn(self._title),
                BarColumn(),
                TextColumn("{task.fields[amount]}"),
                TextColumn("{task.fields[status]}"),
                TimeRemainingColumn(),
                console=self._console,
                transient=True,
            )
            self._task = self._bar.add_task("", total=self._total, amount="", status="")
            self._bar.start()
        self._bar.update(self._task, completed=self._done, amount=self._amount, status=self._status)
