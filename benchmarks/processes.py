# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The processes of a measurement: nodes in a domain of their own, spoken to through pipes."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pdeloop.domain import given_domain, own_domain
from pdeloop.messages.problem import find_problem
from pdeloop.process.isolation import loopback_environment
from pdeloop.process.module_path import PROJECT, safe_environment
from pdeloop.process.start import die_with
from pdeloop.supervisor import START, node_arguments

ANSWER = 300.0
"""Longest silence of a process that was asked something, in s."""


_RUN = """\
import runpy, sys
sys.path.append({folder!r})
sys.argv[0] = {name!r}
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


def program(name: str, *words: str) -> list[str]:
    """The command that runs a module of this checkout, whose folder comes last on the module path.

    Most of these are not installed, and whatever else lies in the checkout is not to be imported.
    """
    return [sys.executable, "-c", _RUN.format(folder=str(PROJECT), name=name), *words]


class BenchError(RuntimeError):
    """A process of a measurement ended; the text has its last words."""


class BenchProcess:
    """A node whose stdin and stdout carry one JSON object a line."""

    def __init__(self, process: subprocess.Popen[str], log: Path) -> None:
        self.process, self._log = process, log

    def ask(self, **request: Any) -> dict[str, Any]:
        """The answer to one request. BenchError when the process has ended instead."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(self.line())
        return answer

    def line(self) -> str:
        """The next line of its output. BenchError when the process has ended instead."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            words = self.log().strip().splitlines()[-1:]
            raise BenchError(f"a process of the measurement ended: {' '.join(words)}")
        return line

    def log(self) -> str:
        """The node's log so far."""
        return self._log.read_text(errors="replace")

    def processor_times(self) -> dict[str, float]:
        """Seconds of processor time so far: `own`, of the node's threads, and `middleware` (Linux)."""
        times = {"own": 0.0, "middleware": 0.0}
        for thread in Path(f"/proc/{self.process.pid}/task").iterdir():
            with contextlib.suppress(OSError):  # it has ended in the meantime
                whose = (thread / "comm").read_text().startswith("dds.")
                nanoseconds = int((thread / "schedstat").read_text().split()[0])
                times["middleware" if whose else "own"] += 1e-9 * nanoseconds
        return times

    def end(self) -> None:
        """Ask the node to end, and wait for it."""
        self.process.terminate()
        try:
            self.process.wait(5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Bench:
    """Starts nodes; all of them end with the block that made it."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder = folder
        self.environment = {
            **safe_environment(os.environ),
            **loopback_environment(),
            "ROS_DOMAIN_ID": str(domain),
            "ROS_LOG_DIR": str(folder),
            "PYTHONUNBUFFERED": "1",
        }
        self._started: list[subprocess.Popen[str]] = []

    def start(
        self,
        name: str,
        *parameters: str,
        problem: str | None = None,
        namespace: str = "",
        remaps: Sequence[str] = (),
        prefix: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> BenchProcess:
        """Start the node of package `name` with parameters written NAME:=VALUE.

        prefix: words in front of the command, such as `ip netns exec`; environment: in addition.
        """
        words = ["--params-file", str(find_problem(problem).absolute())] if problem else []
        words += ["-r", f"__ns:=/{namespace}"] if namespace else []
        words += [word for parameter in parameters for word in ("-p", parameter)]
        words += [word for remap in remaps for word in ("-r", remap)]
        command = [*prefix, *program(START, name, *node_arguments(*words))]
        # Not in the checkout: a process takes its working directory off the module path.
        return self.run(
            name, command, {**self.environment, **(environment or {})}, str(self.folder)
        )

    def run(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
        folder: str | None = None,
    ) -> BenchProcess:
        """Start any command, in this working directory; its log has that name."""
        log = self.folder / f"{len(self._started)}-{name}.log"
        with log.open("wb") as stderr:
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
                env=environment or self.environment,
                cwd=folder,
                process_group=0,  # Ctrl-C in the terminal reaches the measuring program only
                preexec_fn=partial(die_with, os.getpid()),
            )
        self._started.append(process)
        return BenchProcess(process, log)

    def stop(self) -> None:
        """End every process."""
        for process in self._started:
            process.terminate()
        deadline = time.monotonic() + 2.0
        for process in self._started:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with contextlib.suppress(BrokenPipeError):
                        pipe.close()


@contextlib.contextmanager
def bench() -> Iterator[Bench]:
    """Processes in a domain and a temporary folder of their own."""
    given = given_domain()
    # One that the user gave is reserved by the training that is measured, if one is.
    held = own_domain() if given is None else contextlib.nullcontext(given)
    with tempfile.TemporaryDirectory() as folder, held as domain:
        running = Bench(Path(folder), domain)
        try:
            yield running
        finally:
            running.stop()


def machine() -> dict[str, Any]:
    """The machine that a figure was measured on, without names."""
    return {
        "cores": os.cpu_count(),
        "architecture": platform.machine(),
        "system": platform.system(),
        "python": platform.python_version(),
        "load": os.getloadavg()[0],
    }


def ended_well(process: BenchProcess) -> bool:
    """True once a process has ended. BenchError, with its last words, if it failed."""
    code = process.process.poll()
    if code:
        words = process.log().strip().splitlines()[-1:]
        raise BenchError(f"a process of the measurement ended with code {code}: {' '.join(words)}")
    return code is not None


def progress(folder: Path) -> list[dict[str, Any]]:
    """The rows of a run's progress.jsonl so far."""
    path = folder / "progress.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("}")]


def table(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> str:
    """A Markdown table of these entries of the rows, by what stands above them."""
    return markdown(
        tuple(columns.values()), [[shown(row[name]) for name in columns] for row in rows]
    )


def shown(value: object) -> str:
    """An entry of a table: numbers with three digits at least, truth as a word."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return str(value)


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    return "\n".join(lines)
