# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop` as a process, on a pseudo-terminal or without."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from tests.support.interpreter import ROOT
from tests.support.loop_harness import Forked

PDELOOP = [sys.executable, "-m", "pdeloop.cli"]
CONTROL = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]")
COLOUR = re.compile(r"\x1b\[(?:\d+;)*(?:3[0-8]|4[0-8]|9[0-7]|10[0-7])(?:;\d+)*m")
LIMIT = 240.0
"""Seconds for a command, on a busy machine that has to compile the kernels first."""


def run(*words: str, environment: Mapping[str, str] | None = None, cwd: Path | None = None):
    """The command in a process of its own, with its output in pipes."""
    return subprocess.run(
        [*PDELOOP, *words],
        env={**os.environ, "PYTHONPATH": str(ROOT), **(environment or {})},
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )


class Terminal:
    """A process on a pseudo-terminal: what is typed and what is shown.

    `pdeloop` is forked from a process that has everything loaded, other programs are executed.
    """

    def __init__(self, *command: str, cwd: Path, environment: Mapping[str, str]) -> None:
        self.master, slave = pty.openpty()
        own = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", **environment}
        self.process: Forked | subprocess.Popen[bytes]
        if list(command[: len(PDELOOP)]) == PDELOOP:
            words = command[len(PDELOOP) :]
            self.process = Forked("pdeloop", words, cwd / "pdeloop.log", own, terminal=slave)
        else:
            self.process = subprocess.Popen(
                command,
                stdin=slave,
                stdout=slave,
                stderr=slave,
                cwd=cwd,
                env=own,
                start_new_session=True,
                preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # of which it is in charge
            )
        os.close(slave)
        self.shown = ""

    def read(self, seconds: float) -> bool:
        """Take what comes within `seconds`; False at the end."""
        if not select.select([self.master], [], [], seconds)[0]:
            return True
        try:
            new = os.read(self.master, 65536)
        except OSError:
            return False
        self.shown += new.decode(errors="replace")
        return bool(new)

    def until(self, text: str) -> str:
        """What is shown when `text` is (escape sequences left out)."""
        deadline = time.monotonic() + LIMIT
        while text not in self.plain:
            assert time.monotonic() < deadline, f"no {text!r} in {self.plain!r}"
            if not self.read(0.1):
                assert text in self.plain, f"no {text!r} in {self.plain!r}"
        return self.plain

    @property
    def plain(self) -> str:
        return CONTROL.sub("", self.shown)

    def type(self, text: str) -> None:
        """Type `text`, forgetting what was shown before."""
        self.shown = ""
        os.write(self.master, text.encode())

    def wait(self) -> int:
        """Read to the end; the exit code."""
        deadline = time.monotonic() + LIMIT
        while self.read(0.1) and time.monotonic() < deadline:
            pass
        return self.process.wait(LIMIT)


@contextlib.contextmanager
def terminal(*command: str, cwd: Path, **environment: str) -> Iterator[Terminal]:
    started = Terminal(*command, cwd=cwd, environment=environment)
    try:
        yield started
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(started.process.pid, signal.SIGKILL)
        started.process.wait(LIMIT)
        os.close(started.master)
