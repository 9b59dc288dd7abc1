"""How far something is: a live bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn


def bar(console: Console, title: str, amount: ProgressColumn) -> Progress:
    """A bar that leaves no trace: title, bar, how much is done, its `status`, the time left."""
    return Progress(
        TextColumn(title),
        BarColumn(),
        amount,
        TextColumn("{task.fields[status]}"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    )


def duration(seconds: float) -> str:
    """Seconds as people say them."""
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    minutes, hours = round(seconds / 60), seconds / 3600
    return f"{minutes} min" if minutes < 100 else f"{hours:.1f} h"


class Share:
    """Shows the share of a task that is done.

    On a terminal a bar; elsewhere a line every tenth, with the time left as it seems then.
    """

    def __init__(self, console: Console, title: str) -> None:
        self._console, self._title = console, title
        self._bar: Progress | None = None
        self._task: Any = None
        self._began = time.monotonic()
        self._first: float | None = None
        self._told = 0

    def tell(self, share: float, status: str = "") -> None:
        """Now `share` (0 to 1) is done; status: a few words on what was done last."""
        if self._first is None:
            self._first, self._told = share, int(10 * share)
        if self._console.is_terminal:
            self._draw(share, status)
        elif int(10 * share) > self._told:
            self._told = int(10 * share)
            taken = time.monotonic() - self._began
            left = duration(taken * (1 - share) / (share - self._first))
            words = [f"{self._title}: {100 * share:.0f} % done", status, f"{left} left"]
            self._console.print(", ".join(word for word in words if word), markup=False)

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _draw(self, share: float, status: str) -> None:
        if self._bar is None:
            amount = TextColumn("{task.percentage:>3.0f} %")
            self._bar = bar(self._console, self._title, amount)
            self._task = self._bar.add_task("", total=1.0, status="")
            self._bar.start()
        self._bar.update(self._task, completed=share, status=status)
