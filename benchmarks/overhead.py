"""`python -m benchmarks overhead WHAT`: how much a recorder, a viewer or the live page slows a loop.

The same three nodes train all the time and only the other process comes and goes, so that what else
the machine does weighs on both sides alike. A viewer is looked at by somebody who reads all of its
topics, the live page by a client that takes all that a browser would (benchmarks.reader).
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.processes import BenchError
from loop_interfaces.affinity import usable_cores
from loop_interfaces.isolation import loopback_environment
from loop_interfaces.problem import find_problem
from pdeloop.domain import own_domain
from pdeloop.pairs import pair_cores, pair_nodes
from pdeloop.supervisor import keep_on, node_command

PATIENCE = 60.0
"""Seconds within which a process must be at work, or have ended."""
READER = (sys.executable, "-m", "benchmarks.reader")


@dataclass
class Setting:
    """Where a measurement takes place. Processes that `start` has started end with it."""

    problem: str
    folder: Path
    environment: dict[str, str]
    others: Sequence[int] = ()
    """Cores that plant and controller, which share one, leave to others."""
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def start(self, name: str, *command: str) -> subprocess.Popen[bytes]:
        """Run a command with its output in the file NAME.log."""
        with (self.folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                command, env=self.environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        self.processes.append(process)
        return process

    def start_beside(self, name: str, *command: str) -> None:
        """The same, off the pair's core, where `pdeloop train` starts such a process itself."""
        keep_on(self.start(name, *command).pid, self.others)

    def wait(self, name: str, pattern: str) -> str:
        """What its output says where it matches `pattern`, once it does."""
        limit = time.monotonic() + PATIENCE
        while True:
            said = (self.folder / f"{name}.log").read_text(errors="replace")
            if found := re.search(pattern, said):
                return found[0]
            if time.monotonic() > limit:
                raise BenchError(f"{name} is not at work after {PATIENCE:g} s: {said[-300:]}")
            time.sleep(0.05)


def recorder(setting: Setting, window: int) -> None:
    """A recorder, once it is matched and its start is over."""
    bag = setting.folder / f"bag{window}"
    setting.start_beside("recorder", *node_command("recorder_node", "-p", f"bag:={bag}"))
    while not (bag / "parameters.json").exists():
        time.sleep(0.05)


def viewer(setting: Setting, window: int) -> None:
    """A viewer, and who looks at it."""
    given = ("--params-file", str(find_problem(setting.problem)))
    setting.start_beside("viewer", *node_command("viewer_node", *given))
    setting.start(f"views{window}", *READER)
    setting.wait(f"views{window}", "reading")


def monitor(setting: Setting, window: int) -> None:
    """`pdeloop monitor`, and an open page."""
    name = f"monitor{window}"
    setting.start(name, sys.executable, "-m", "pdeloop.cli", "monitor", "--port", "0")
    address = setting.wait(name, r"http://[\d.:]+/")
    setting.start(f"page{window}", *READER, address)
    setting.wait(f"page{window}", "reading")


COMPANY: dict[str, Callable[[Setting, int], None]] = {
    "recorder": recorder,
    "viewer": viewer,
    "monitor": monitor,
}


@contextlib.contextmanager
def beside(what: str, setting: Setting, window: int) -> Iterator[None]:
    """Have it at work within the block, and end it then."""
    before = len(setting.processes)
    COMPANY[what](setting, window)
    yield
    for process in setting.processes[before:]:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(PATIENCE / 10)
        except subprocess.TimeoutExpired:  # rclpy.spin now and then sleeps through a signal
            process.kill()
            process.wait()


def run(what: str, problem: str = "burgers", windows: int = 6, seconds: float = 3.0) -> Any:
    """Time of an iteration, and processor time of plant and controller for one, without and beside.

    Parameters
    ----------
    what
        One of `COMPANY`.
    problem, windows, seconds
        The loop's; how many windows of so many seconds without it, and with it.
    """
    times: tuple[list[float], list[float]] = ([], [])
    processor: tuple[list[float], list[float]] = ([], [])
    with tempfile.TemporaryDirectory() as name, own_domain() as domain:
        given = {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": name}
        environment = {**os.environ, **loopback_environment(), **given}
        setting = Setting(problem, Path(name), environment)
        folder = setting.folder / "run"

        def start(node: str, *parameters: str) -> subprocess.Popen[bytes]:
            words = [word for p in parameters for word in ("-p", p)]
            file = ("--params-file", str(find_problem(problem)))
            return setting.start(node, *node_command(node, *file, *words))

        try:
            cores = pair_cores(1)
            setting.others = [core for core in usable_cores() if core not in cores]
            nodes = [start(node.package, *node.assignments) for node in pair_nodes(cores)]
            # The tuner's own share of the processor is small.
            start("tuner_node", f"out:={folder}", "iterations:=100000", "optimizer:=two_point")
            progress = folder / "progress.jsonl"

            def observe(side: int) -> None:
                before = _processor_time(nodes)
                found = _iterations(progress, seconds)
                times[side].extend(found)
                processor[side].append((_processor_time(nodes) - before) / (len(found) + 1))

            while not (progress.exists() and '"adapted"' in progress.read_text()):
                time.sleep(0.1)
            for window in range(windows):
                observe(0)
                with beside(what, setting, window):
                    time.sleep(0.5)
                    observe(1)
                time.sleep(0.5)
        finally:
            for process in setting.processes:
                process.kill()
                process.wait()
    return {
        "what": what,
        "problem": problem,
        "iterations": [len(some) for some in times],
        "iteration": [statistics.median(some) for some in times],
        "processor": [statistics.median(some) for some in processor],
    }


def text(result: dict[str, Any]) -> str:
    """The result for people."""
    (off, on), (cpu_off, cpu_on) = result["iteration"], result["processor"]
    count_off, count_on = result["iterations"]
    return (
        f"{result['problem']}: median iteration {1e3 * off:.2f} ms without a {result['what']} "
        f"({count_off} iterations), {1e3 * on:.2f} ms with one ({count_on}), ratio {on / off:.3f}, "
        f"of the means {count_off / max(count_on, 1):.3f}\n"
        f"  processor time of plant and controller {1e3 * cpu_off:.2f} ms without, "
        f"{1e3 * cpu_on:.2f} ms with one, ratio {cpu_on / cpu_off:.3f}"
    )


def _processor_time(processes: Sequence[subprocess.Popen[bytes]]) -> float:
    """Seconds of processor time that `processes` have used so far (Linux)."""
    ticks = 0
    for process in processes:
        fields = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def _iterations(progress: Path, seconds: float) -> list[float]:
    """Times of the iterations of the next `seconds`."""
    position = progress.stat().st_size
    time.sleep(seconds)
    with progress.open() as file:
        file.seek(position)
        lines = [line for line in file.read().splitlines() if line.endswith("}")]
    stamps = [json.loads(line)["time"] for line in lines[1:]]
    return [b - a for a, b in itertools.pairwise(stamps)]
