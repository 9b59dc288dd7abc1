# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Calls of this process on the files of a folder: counted, and the n-th of them does something else."""

from __future__ import annotations

import fcntl
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

CHANGING = ("open", "fsync", "replace", "rename", "unlink", "mkdir")
"""Calls that change what a killed process leaves."""
EVERY = (*CHANGING, "write", "close", "look", "read", "stat", "flock")
"""`look` opens for reading."""


class FailingCalls:
    """Calls `fail` with the name and the file of the n-th call that concerns `folder`, before it.

    fail_at: n, from 1; 0: of none. What `fail` raises is what the call raises.
    """

    def __init__(self, folder: Path, fail_at: int, fail: Callable[[str, Any], None]) -> None:
        self._folder, self._fail_at, self._fail = str(folder), fail_at, fail
        self.calls: list[str] = []
        """Names of all calls so far."""
        for name in (*CHANGING, "stat"):
            setattr(os, name, self._counted(getattr(os, name), name))
        fcntl.flock = self._counted(fcntl.flock, "flock")
        self._open_file = io.open
        io.open = self._opened  # of os.fdopen and Path.open

    def count(self, name: str, subject: Any) -> None:
        """One call more, which fails if it is the n-th."""
        self.calls.append(name)
        if len(self.calls) == self._fail_at:
            self._fail(name, subject)

    def _counted(self, call: Callable[..., Any], name: str) -> Callable[..., Any]:
        def counted(subject: Any, *rest: Any, **more: Any) -> Any:
            if self._is_ours(subject):
                self.count(_look_or_open(name, rest), subject)
            return call(subject, *rest, **more)

        return counted

    def _is_ours(self, subject: Any) -> bool:
        if hasattr(subject, "fileno"):
            subject = subject.fileno()
        if isinstance(subject, int):
            subject = Path(f"/proc/self/fd/{subject}").readlink()
        return str(subject).startswith(self._folder)

    def _opened(self, file: Any, mode: str = "r", *rest: Any, **more: Any) -> Any:
        """In place of `io.open`: a file of the folder, whose reads, writes and closing are counted."""
        if not self._is_ours(file):
            return self._open_file(file, mode, *rest, **more)
        if not isinstance(file, int):
            self.count(_look_or_open("open", (mode,)), file)
        raw = _CountedFile(file, mode.replace("b", ""), self)
        if "+" in mode:
            return io.BufferedRandom(raw)
        made = io.BufferedReader(raw) if "r" in mode else io.BufferedWriter(raw)
        return made if "b" in mode else io.TextIOWrapper(made, encoding="utf-8")


def _look_or_open(name: str, rest: tuple[Any, ...]) -> str:
    """The name of a call: opening for reading has one of its own."""
    how = rest[0] if name == "open" and rest else "w"
    writes = how & (os.O_WRONLY | os.O_RDWR) if isinstance(how, int) else how not in ("r", "rb")
    return name if writes else "look"


class _CountedFile(io.FileIO):
    def __init__(self, file: Any, mode: str, calls: FailingCalls) -> None:
        super().__init__(file, mode)
        self._name, self._calls = Path(f"/proc/self/fd/{self.fileno()}").readlink(), calls

    def readinto(self, buffer: Any) -> Any:
        self._calls.count("read", self._name)
        return super().readinto(buffer)

    def readall(self) -> Any:
        self._calls.count("read", self._name)
        return super().readall()

    def write(self, content: Any) -> Any:
        self._calls.count("write", self._name)
        return super().write(content)

    def close(self) -> None:
        was_open = not self.closed
        super().close()
        if was_open:  # it is closed, also if that fails
            self._calls.count("close", self._name)
