# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Display of a run on the terminal: lines for events, a bar while it adapts."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from pdeloop.messages.documents import parse_json
from pdeloop.output import complain, drop_unwritable
from tuner_node.narration import Narration

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


_MOST_AT_ONCE = 4_000_000
"""Bytes of progress.jsonl that are read in one go."""


class StreamConsole(Console):
    """Lines and a bar on a stream, for work that continues when the stream can no longer be written."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(file=stream, highlight=False, soft_wrap=True)

    def on_broken_pipe(self) -> None:
        """Raise when the reader has left. That ends the command; rich would exit with 1."""
        raise BrokenPipeError

    def print(self, *objects: Any, **how: Any) -> None:
        """A line that cannot be written (full disk) is lost, and so are all later ones."""
        try:
            super().print(*objects, **how)
        except BrokenPipeError:
            raise
        except UnicodeEncodeError as error:  # the stream of a program with its own encoding
            texts = (str(one).encode(error.encoding, "backslashreplace") for one in objects)
            super().print(*(text.decode(error.encoding) for text in texts), **how)
        except OSError as error:
            complain(f"no more lines can be written ({error.strerror}); the work continues")
            self.quiet = True
            drop_unwritable()


class Display:
    """Shows a training of `seeds` seeds from `seed` on, row by row.

    `remarks`: the warnings, and the lines about its explorations, such as inputs that they hardly tell
    apart.
    """

    def __init__(self, seed: int, seeds: int, stream: TextIO | None = None) -> None:
        self.remarks: list[str] = []
        self._console = StreamConsole(stream or sys.stdout)
        self._narration = Narration(seed, seeds)
        self._progress: Progress | None = None

    def line(self, text: str) -> None:
        """One line of text."""
        self._console.print(text, markup=False)

    def warn(self, text: str) -> None:
        """One line that must not be overlooked."""
        self.remarks.append(text)
        self._console.print(f"  WARNING: {text}", markup=False, style="bold yellow")

    def row(self, row: Mapping[str, Any]) -> None:
        """Show one row of progress.jsonl."""
        if row.get("event") == "phase":
            self.close()
        lines = self._narration.lines(row)
        for text in lines:
            self.line(text)
        if row.get("event") == "excitation":
            self.remarks += lines
        if row.get("event") == "phase" and row["phase"] == "adapt":
            self._progress = Progress(self._console, "  adapting", "rollouts")
            if self._console.is_terminal:  # the first fit of models may take a minute
                self._progress.tell(self._narration.done, self._narration.budget)
        if row.get("event") == "adapted" and self._progress is not None:
            known = self._narration
            self._progress.tell(known.done, known.budget, known.status)

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._progress is not None:
            self._progress.close()
            self._progress = None


class ProgressFile:
    """Follows a progress.jsonl that another process appends to.

    past: also its existing lines.
    """

    def __init__(self, path: Path, *, past: bool = False) -> None:
        self._path = path
        self._position = path.stat().st_size if path.exists() and not past else 0
        self._rest = b""

    def rows(self) -> list[dict[str, Any]]:
        """The complete lines since the last call, of very much the first part."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._position)
                new = file.read(_MOST_AT_ONCE)
        except FileNotFoundError:
            return []
        self._position += len(new)
        *lines, self._rest = (self._rest + new).split(b"\n")
        found = []
        for line in lines:
            with contextlib.suppress(ValueError):  # torn by a disk that was full
                row = parse_json(line)
                found += [row] if isinstance(row, dict) else []
        return found
