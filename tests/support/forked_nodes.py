# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The nodes of a `pdeloop train` that was itself forked are forked from it, not executed.

They need neither an interpreter nor imports of their own, which cost more than most trainings of the
tests. What the supervisor has in hand is a `Popen` as always: of a child of its own, in a session
of its own, with the log as its output, that dies with it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from pdeloop import supervisor
from pdeloop.process.start import run


def fork_nodes(folder: Path) -> None:
    """From now on the supervisors of this process fork their nodes. folder: of the test."""

    def start(
        command: Sequence[str], *, env: Mapping[str, str], **how: Any
    ) -> subprocess.Popen[bytes]:
        start_of_command = [sys.executable, "-m", supervisor.START]
        assert list(command[:3]) == start_of_command, command
        for stream in sys.stdout, sys.stderr:
            stream.flush()  # otherwise the child has what is in their buffers, too

        def become_the_node() -> None:
            _be_node(list(command[3:]), env, folder)

        # It never gets as far as to execute the command.
        return subprocess.Popen(command, preexec_fn=become_the_node, **how)

    names = ("DEVNULL", "STDOUT", "TimeoutExpired")
    own = {name: getattr(subprocess, name) for name in names}
    vars(supervisor)["subprocess"] = SimpleNamespace(Popen=start, **own)


def _be_node(words: list[str], environment: Mapping[str, str], folder: Path) -> None:
    """Run a node in a process that was just forked, and end with it."""
    try:
        for descriptor in [int(path.name) for path in Path("/proc/self/fd").iterdir()]:
            if descriptor > 2:  # among them the pipe on which Popen waits for the execution
                _close(descriptor)
        os.environ.clear()
        os.environ.update(environment)
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # as an interpreter that starts
        sys.stdout.reconfigure(write_through=True)  # type: ignore[attr-defined]
        note(words[0], folder)
        sys.argv = words
        run(words[0])
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(1)


def _close(descriptor: int) -> None:
    try:
        os.close(descriptor)
    except OSError:
        return  # that of the folder itself


def note(node: str, folder: Path) -> None:
    """Leave a file that tells the test of this process, whose environment does not show whose it is."""
    place = folder / "forked"
    place.mkdir(exist_ok=True)
    (place / f"{os.getpid()}-{node}").write_text(began(os.getpid()))


def running(folder: Path) -> dict[int, str]:
    """The forked nodes of the test in `folder` that still run, and their names."""
    found = {}
    for path in (folder / "forked").glob("*"):
        pid, _, node = path.name.partition("-")
        if began(int(pid)) and began(int(pid)) == path.read_text():
            found[int(pid)] = node
    return found


def began(pid: int) -> str:
    """When a process began, in ticks since the machine did; empty if it is no more."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return ""
    return "" if words[0] == "Z" else words[19]
