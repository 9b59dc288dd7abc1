# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Display of a run on the terminal: lines for events, a bar while it adapts."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console

from pdeloop.messages.documents import parse_json
from pdeloop.output import complain, drop_unwritable
from pdeloop.progress import Progress
from tuner_node.narration import Narration

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

    `remarks`: the lines about its explorations, such as inputs that they hardly tell apart.
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
