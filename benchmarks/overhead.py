"""How much something beside a loop slows it: one training, that something beside it now and then.

The same three nodes run all the time and only the other process comes and goes, so that what else
the machine does weighs on both sides alike.
"""

from __future__ import annotations

import itertools
import json
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from loop_interfaces.affinity import usable_cores
from loop_interfaces.isolation import loopback_environment
from loop_interfaces.problem import find_problem
from pdeloop.domain import own_domain
from pdeloop.pairs import pair_cores, pair_nodes
from pdeloop.supervisor import keep_on, node_command


@dataclass
class Setting:
    """Where a measurement takes place. Processes that `start` has started end with it."""

    folder: Path
    environment: dict[str, str]
    others: Sequence[int] = ()
    """Cores that plant and controller, which share one, leave to others."""
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def start(self, command: Sequence[str], name: str) -> subprocess.Popen[bytes]:
        """Run a command with its output in the file NAME.log."""
        with (self.folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                command, env=self.environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        self.processes.append(process)
        return process

    def start_child(self, command: Sequence[str], name: str) -> subprocess.Popen[bytes]:
        """The same, where `pdeloop train` starts such a process itself."""
        process = self.start(command, name)
        keep_on(process.pid, self.others)
        return process

    def log(self, name: str) -> str:
        """What the command with that name has printed."""
        return (self.folder / f"{name}.log").read_text(errors="replace")


Company = Callable[[Setting, int], AbstractContextManager[None]]
"""What comes beside the loop in a window of this number: it is there within the block."""


def measure(
    problem: str, windows: int, seconds: float, company: Company, tuner: Sequence[str] = ()
) -> dict[str, Any]:
    """Time of an iteration, and processor time of plant and controller for one, without and beside.

    windows: of each of the two; tuner: parameters NAME:=VALUE of the tuner.
    """
    times: tuple[list[float], list[float]] = ([], [])
    processor: tuple[list[float], list[float]] = ([], [])
    with tempfile.TemporaryDirectory() as name, own_domain() as domain:
        given = {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": name}
        setting = Setting(Path(name), {**os.environ, **loopback_environment(), **given})
        run = setting.folder / "run"

        def start(node: str, *parameters: str) -> subprocess.Popen[bytes]:
            words = [word for p in parameters for word in ("-p", p)]
            command = node_command(node, "--params-file", str(find_problem(problem)), *words)
            return setting.start(command, node)

        try:
            cores = pair_cores(1)
            setting.others = [core for core in usable_cores() if core not in cores]
            nodes = [start(node.package, *node.assignments) for node in pair_nodes(cores)]
            start("tuner_node", f"out:={run}", "iterations:=100000", "optimizer:=two_point", *tuner)
            progress = run / "progress.jsonl"

            def observe(beside: int) -> None:
                before = _processor_time(nodes)
                found = _iterations(progress, seconds)
                times[beside].extend(found)
                processor[beside].append((_processor_time(nodes) - before) / (len(found) + 1))

            while not (progress.exists() and '"adapted"' in progress.read_text()):
                time.sleep(0.1)
            for window in range(windows):
                observe(0)
                with company(setting, window):
                    time.sleep(0.5)
                    observe(1)
                time.sleep(0.5)
        finally:
            for process in setting.processes:
                process.kill()
                process.wait()
    return {
        "problem": problem,
        "iterations": [len(some) for some in times],
        "iteration": [statistics.median(some) for some in times],
        "processor": [statistics.median(some) for some in processor],
    }


def text(result: dict[str, Any], what: str) -> str:
    """The result for people; what: that which comes and goes, with its article."""
    (off, on), (cpu_off, cpu_on) = result["iteration"], result["processor"]
    count_off, count_on = result["iterations"]
    return (
        f"{result['problem']}: median iteration {1e3 * off:.2f} ms without {what} "
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
