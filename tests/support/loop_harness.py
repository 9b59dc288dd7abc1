# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Real nodes in real processes on a ROS domain of their own, with a limit on every wait.

Most of what it takes to start a node is imports and the loading of compiled code, a second of a
core. So what a test starts, nodes, commands and pieces of Python, is forked from a process
that has done that (`preloaded`), and so are the nodes of a training that was forked (`forked_nodes`).

All of them die with the process that runs the tests, however that ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from multiprocessing import forkserver, reduction
from pathlib import Path
from typing import Any

import pytest

import pdeloop.domain
from pde_sim_node import run_record
from pdeloop import supervisor
from pdeloop.domain import DOMAINS_FOLDER, own_domain
from pdeloop.process.isolation import loopback_environment
from pdeloop.process.start import BLAS_THREADS, die_with
from tests.support import forked_nodes
from tests.support.domains import share_domains

ROOT = Path(__file__).resolve().parents[2]
FORKING = multiprocessing.get_context("forkserver")
PRELOADED = "tests.support.preloaded"
FORKING.set_forkserver_preload([PRELOADED])


def until(condition: Callable[[], object], limit: float, what: str) -> None:
    """Wait until `condition()`; AssertionError naming `what` after `limit` seconds."""
    deadline = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < deadline, f"no {what} within {limit} s"
        time.sleep(0.02)


def udp_sockets(pid: int) -> list[tuple[str, int]]:
    """Local address (hexadecimal) and port of the UDP sockets of a process."""
    inodes = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        target = str(entry.readlink())
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    lines = Path(f"/proc/{pid}/net/udp").read_text().splitlines()[1:]
    own = [line.split()[1].split(":") for line in lines if line.split()[9] in inodes]
    return [(address, int(port, 16)) for address, port in own]


class Duplicated:
    """A descriptor of this process, of which one that is forked gets a duplicate: its number."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def __reduce__(self) -> tuple[Any, ...]:
        return _number, (reduction.DupFd(self._descriptor),)


def _number(duplicate: Any) -> int:
    number: int = duplicate.detach()
    return number


class Forked:
    """A node or a program in a process that was forked, not executed; used like a Popen.

    name: one of tests.support.preloaded.MAINS, or "-c" and the first argument is Python, as for an
    interpreter. Its output goes into the file `log`, and it works in the folder of that. terminal:
    descriptor of one of which it is in charge, with its input and output.
    """

    def __init__(
        self,
        name: str,
        arguments: Sequence[str],
        log: Path,
        environment: Mapping[str, str],
        terminal: int | None = None,
    ) -> None:
        self.name, self.args, self.log = name, [name, *arguments], log
        log.touch()
        own = () if terminal is None else (Duplicated(terminal),)
        self._process = forked(run_main, name, list(arguments), log, dict(environment), *own)
        assert self._process.pid is not None
        self.pid = self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        code = self._process.exitcode
        if code is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def forked(target: Callable[..., None], *given: Any) -> Any:
    """A started process that was forked from the one that has everything loaded.

    That one looks for it where PYTHONPATH says. Under PYTHONSAFEPATH it knows no other place, and
    multiprocessing keeps silent about what it cannot load.
    """
    process = FORKING.Process(target=target, args=given)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)
        patch.setenv(BLAS_THREADS, "1")  # as what is forked from it would have it
        process.start()
    return process


def become(log: Path, environment: Mapping[str, str]) -> None:
    """Make a forked process one of a test's own: its session, output, environment and folder.

    It dies with the process that it was forked from, which ends with the one that runs the tests,
    unless another holds the descriptor by which it knows.
    """
    die_with(os.getppid())
    os.close(forkserver._forkserver._forkserver_alive_fd)
    os.setsid()
    with log.open("wb") as output, Path(os.devnull).open("rb") as nothing:
        for file, number in ((nothing, 0), (output, 1), (output, 2)):
            os.dup2(file.fileno(), number)
    assert PRELOADED in sys.modules, "forked from a process that could not load anything"
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None  # which it looks for again, as a program that starts
    domains = Path(tempfile.gettempdir()) / DOMAINS_FOLDER.name
    pdeloop.domain.DOMAINS_FOLDER = pdeloop.domain.DOMAINS_FOLDER = domains
    os.chdir(log.parent)


def take_over(terminal: int) -> None:
    """Let this process, which leads a session, be in charge of a terminal."""
    fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)
    for number in range(3):
        os.dup2(terminal, number)
    os.close(terminal)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[attr-defined]  # as Python has it


def run_main(
    name: str,
    arguments: list[str],
    log: Path,
    environment: dict[str, str],
    terminal: int | None = None,
) -> None:
    """What `Forked` runs, in the forked process."""
    become(log, environment)
    if terminal is not None:
        take_over(terminal)
    if name == "-c":
        code, *arguments = arguments
        sys.argv = [name, *arguments]
        exec(code, {"__name__": "__main__"})
        return
    from tests.support.forked_nodes import fork_nodes
    from tests.support.forked_workers import fork_workers_here
    from tests.support.preloaded import MAINS

    if name == "pdeloop":
        fork_nodes(log.parent)
        fork_workers_here()
    sys.argv = [name, *arguments]
    sys.exit(MAINS[name]())


class Processes:
    """The processes of one test. All are gone when it is over.

    forks: whether what it starts is forked; set it to False where that needs an interpreter that
    was started in this test's environment.
    """

    forks = True

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder = folder
        self.environment = {
            **os.environ,
            **loopback_environment(),
            "ROS_DOMAIN_ID": str(domain),
            "ROS_LOG_DIR": str(folder / "ros_logs"),
            "PYTHONPATH": str(ROOT),
        }
        self._alive: list[subprocess.Popen[bytes] | Forked] = []
        self._count = 0

    def start(self, *command: str, name: str = "") -> Any:
        """Run `python COMMAND...` with its output in a file (see `output`)."""
        if self.forks and command[0] == "-c":
            return self._fork(self._new_log(name or Path(command[-1]).name), *command)
        return self.program(sys.executable, *command, name=name)

    def program(self, *command: str, name: str = "") -> Any:
        """Run any program in the same way."""
        path = self._new_log(name or Path(command[-1]).name)
        with path.open("wb") as log:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self.environment,
                cwd=self.folder,
                start_new_session=True,
                preexec_fn=partial(die_with, os.getpid()),
            )
        process.log = path  # type: ignore[attr-defined]
        self._alive.append(process)
        return process

    def _new_log(self, name: str) -> Path:
        self._count += 1
        return self.folder / f"{self._count:02d}-{name}.log"

    def _fork(self, log: Path, name: str, *arguments: str) -> Forked:
        forked = Forked(name, arguments, log, self.environment)
        self._alive.append(forked)
        return forked

    def node(self, name: str, *ros_arguments: str) -> Any:
        """Start one of our nodes."""
        if self.forks:
            return self._fork(self._new_log(name), name, "--ros-args", *ros_arguments)
        words = ("-m", supervisor.START, name, "--ros-args", *ros_arguments)
        return self.start(*words, name=name)

    def pdeloop(self, *arguments: str) -> Any:
        """Start the command line."""
        if self.forks:
            return self._fork(self._new_log("pdeloop"), "pdeloop", *arguments)
        return self.start("-m", "pdeloop.cli", *arguments, name="pdeloop")

    def output(self, process: subprocess.Popen[bytes]) -> str:
        text: str = process.log.read_text(errors="replace")  # type: ignore[attr-defined]
        return text

    def wait(self, process: subprocess.Popen[bytes], limit: float, code: int = 0) -> str:
        """Wait for the end of `process`, which must come with exit code `code`; its output."""
        try:
            got = process.wait(limit)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {limit} s:\n{self.everything()}") from None
        assert got == code, f"exit code {got}, expected {code}:\n{self.everything()}"
        return self.output(process)

    def everything(self) -> str:
        """What every process printed."""
        return "\n".join(f"== {p.args}\n{self.output(p)[-3000:]}" for p in self._alive)

    def left_behind(self) -> list[int]:
        """Processes of this test that still run, also those its children started."""
        inside = f"ROS_LOG_DIR={self.folder}".encode()
        found = [forked.pid for forked in self._forked()]
        found += forked_nodes.running(self.folder)
        for entry in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                environment = (entry / "environ").read_bytes()
                zombie = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
                if inside in environment and not zombie:
                    found.append(int(entry.name))
        return found

    def _forked(self) -> list[Forked]:
        """The forked ones that still run."""
        return [p for p in self._alive if isinstance(p, Forked) and p.poll() is None]

    def pids(self, node: str) -> list[int]:
        """Processes of this test that run the module `node`.node, whoever started them."""
        found = [forked.pid for forked in self._forked() if forked.name == node]
        children = forked_nodes.running(self.folder)
        found += [pid for pid, name in children.items() if name == node]
        for pid in self.left_behind():
            with contextlib.suppress(OSError):
                words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
                if node in words:
                    found.append(pid)
        return found

    def stop(self) -> None:
        """SIGINT, then SIGKILL, to all and to whatever they started."""
        for number, patience in ((signal.SIGINT, 3.0), (signal.SIGKILL, 3.0)):
            for process in self._alive:
                if process.poll() is None:
                    with contextlib.suppress(ProcessLookupError):
                        os.killpg(process.pid, number)
                        os.killpg(process.pid, signal.SIGCONT)
            deadline = time.monotonic() + patience
            for process in self._alive:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, deadline - time.monotonic()))
        for pid in self.left_behind():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        deadline = time.monotonic() + 60.0  # a killed process takes a moment to end
        while self.left_behind() and time.monotonic() < deadline:
            time.sleep(0.01)


@contextlib.contextmanager
def processes(folder: Path) -> Iterator[Processes]:
    """The processes of one test in a domain that nobody else uses."""
    with own_domain() as domain:
        # The nodes have another temporary folder than this process when it looked for it.
        run_record.forget(domain, Path(tempfile.gettempdir()) / run_record.FOLDER.name)
        running = Processes(folder, domain)
        try:
            yield running
        finally:
            running.stop()


@contextlib.contextmanager
def without_domain(loop: Processes) -> Iterator[None]:
    """As a person uses it: no domain is given, commands take a free one, and find each other's loops.

    They find those of this test only, which are registered in a temporary folder of its own.
    """
    del loop.environment["ROS_DOMAIN_ID"]
    share_domains(loop.folder)
    loop.environment["TMPDIR"] = str(loop.folder)
    yield
