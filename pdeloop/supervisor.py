# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Starts the nodes of a run as processes, restarts those that die, and ends all of them."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pdeloop.messages.files import open_own
from pdeloop.messages.protocol import NO_CONTROLLER, STOPPED
from pdeloop.process.module_path import safe_environment
from pdeloop.process.start import PARENT

STOP_GRACE = 2.0
"""Seconds between SIGINT and SIGKILL when the run ends."""
RECORDER_GRACE = 10.0
"""The same for a recorder, which has a bag to finish."""
BACK_OFF = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Seconds before the first, second, ... restart of a node."""
STEADY = 30.0
"""Seconds of life after which earlier deaths of a node no longer count."""
REFUSED, CRASHED = 1, 70
"""Exit codes of a node that was asked for something it cannot do, so that restarting would not help,
and of one with a bug (pdeloop.ros.node_main)."""
FULL_MEMORY_DISK = "as happens where /dev/shm, which ROS's tracing library maps, or a disk is full"
"""The cause of a SIGBUS."""
START = "pdeloop.process.start"
"""The module that runs a node."""
_WARNING = re.compile(r"\[WARN\] \[([\d.]+)\] (\[.*)")
"""A warning in a node's log."""
_KILLED = range(-64, 0)
"""Exit codes of processes that a signal killed."""


class NodeError(RuntimeError):
    """A node that cannot be kept running; the text has the last line of its log."""


@dataclass
class Child:
    """One node: how it is started and how its life went.

    command: gives its words, before each start; optional: the others continue without it when it ends
    by itself, or dies too often; cores: those that it may use, empty: any; ended: it is optional,
    and has ended for good.
    """

    name: str
    command: Callable[[], Sequence[str]]
    log: Path
    process: subprocess.Popen[bytes] | None = None
    deaths: int = 0
    started: float = 0.0
    due: float | None = 0.0
    optional: bool = False
    cores: Sequence[int] = ()
    ended: bool = False

    def warning(self, since: float) -> str:
        """The last warning of the node's log since a time: what it waits for, if it does."""
        found = [match for line in self._logged() if (match := _WARNING.match(line))]
        return found[-1][2] if found and float(found[-1][1]) >= since else ""

    def last_line(self) -> str:
        """The last line of the node's log."""
        lines = self._logged()
        return lines[-1] if lines else ""

    def refusal(self) -> str:
        """Why the process refused to run, in its one sentence; what ends after it may say more."""
        node = self.name.partition("-")[0]  # behind a hyphen stands its namespace
        said = [line for line in self._logged() if line.startswith(f"{node}: ")]
        return said[-1] if said else self.last_line()

    def _logged(self) -> list[str]:
        try:
            return self.log.read_text(errors="replace").strip().splitlines()
        except OSError:
            return []


@dataclass
class Supervisor:
    """Keeps `children` running until the one called `main` ends by itself.

    domain: ROS_DOMAIN_ID of all of them; tell: one line for the user when something happens.
    """

    children: list[Child]
    main: str
    domain: int
    log_folder: Path
    tell: Callable[[str], None]
    environment: Mapping[str, str]
    """Environment variables of the nodes (pdeloop.process.ros_environment)."""
    stopped: bool = False
    """True if the main node ended because an operator asked it to, through its service."""
    _environment: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._environment = {
            **safe_environment(self.environment),
            "ROS_DOMAIN_ID": str(self.domain),
            "ROS_LOG_DIR": str(self.log_folder),
            "PYTHONUNBUFFERED": "1",
            "RCUTILS_CONSOLE_OUTPUT_FORMAT": "[{severity}] [{time}] [{name}]: {message}",
            "RCUTILS_COLORIZED_OUTPUT": "0",
        }

    def poll(self) -> bool:
        """Start what is due, notice what died; True once the main node has ended well.

        Raises NodeError when a node refuses to run or keeps dying.
        """
        now = time.monotonic()
        for child in self.children:
            if child.process is None:
                if child.due is not None and now >= child.due:
                    self._start(child, now)
                continue
            code = child.process.poll()
            if code is None:
                continue
            if child.name == self.main and code in (0, STOPPED, NO_CONTROLLER):
                self.stopped = code == STOPPED
                return True
            self._ended(child, code, now)
        return False

    def stop(self) -> None:
        """End every node: SIGINT to all, SIGKILL to who is left after STOP_GRACE.

        With a recorder (an optional child) the main node ends first, then the recorder: it must see
        all that the main node did, but a reader drops what it has not taken when the writer leaves.
        """
        recorders = [child for child in self.children if child.optional and child.process]
        groups = [(self.children, STOP_GRACE)]
        if recorders:
            main = [child for child in self.children if child.name == self.main]
            groups = [(main, STOP_GRACE), (recorders, RECORDER_GRACE), *groups]
        for group, grace in groups:
            alive = [child.process for child in group if child.process is not None]
            for process in alive:
                _signal(process, signal.SIGINT)
            deadline = time.monotonic() + grace
            for process in alive:
                try:
                    process.wait(max(0.0, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    _signal(process, signal.SIGKILL)
                    process.wait()
            for child in group:
                child.process, child.due = None, None

    def _start(self, child: Child, now: float) -> None:
        with open_own(child.log, os.O_APPEND) as log:
            child.process = subprocess.Popen(
                child.command(),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                # No code runs between fork and execution: with the threads of a plant's library, such
                # as JAX, in this process it could wait there for ever.
                env={**self._environment, PARENT: str(os.getpid())},
                start_new_session=True,  # Ctrl-C in the terminal reaches the supervisor only
            )
        keep_on(child.process.pid, child.cores)
        child.started, child.due = now, None

    def _ended(self, child: Child, code: int, now: float) -> None:
        """Start a node that ended again, now or later, or give it up."""
        how = (
            f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
        )
        child.process = None
        if code == REFUSED:
            raise NodeError(child.refusal() or f"{child.name} {how}; see {child.log}")
        child.deaths = 1 if now - child.started > STEADY else child.deaths + 1
        often = child.deaths > len(BACK_OFF)
        if child.optional and (often or code not in (CRASHED, *_KILLED)):
            child.ended = True
            self.tell(f"{child.name} {how}; {child.last_line()}")
            return
        if often:
            why = f", {FULL_MEMORY_DISK}" if code == -signal.SIGBUS else ""
            raise NodeError(
                f"{child.name} {how} for the {child.deaths}th time{why}; the last line of its log: "
                f"{child.last_line() or 'none'} (see {child.log})"
            )
        wait = BACK_OFF[child.deaths - 1]
        child.due = now + wait
        self.tell(f"{child.name} {how}; starting it again" + (f" in {wait:g} s" if wait else ""))


def node_command(name: str, *ros_arguments: str) -> list[str]:
    """The command that runs a node with this interpreter."""
    return [sys.executable, "-m", START, name, *node_arguments(*ros_arguments)]


def node_arguments(*ros_arguments: str) -> list[str]:
    """All arguments of a node that is started here."""
    # The log is the child's output: a second one by rcl's logging library would only repeat it.
    return ["--ros-args", "--disable-external-lib-logs", *ros_arguments]


def keep_on(process: int, cores: Sequence[int]) -> None:
    """Keep a process that was just started, and its threads to come, on `cores`; empty: on any."""
    if cores and hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(ProcessLookupError):
            os.sched_setaffinity(process, cores)


def _signal(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
        os.killpg(process.pid, signal.SIGCONT)  # a stopped process must be able to die
