# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks overhead WHAT`: how much a recorder, a viewer or the live page slows a loop.

The same three nodes train all the time and only the other process comes and goes, so that what else
the machine does weighs on both sides alike. A viewer is looked at by somebody who reads all of its
topics, the live page by a client that takes all that a browser would (benchmarks.reader).
"""

from __future__ import annotations

import itertools
import re
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from benchmarks.processes import Bench, BenchProcess, bench, program, progress
from pdeloop.pairs import pair_cores, pair_nodes
from pdeloop.process.affinity import usable_cores
from pdeloop.supervisor import keep_on

READER = "benchmarks.reader"


def recorder(running: Bench, problem: str, others: Sequence[int]) -> list[BenchProcess]:
    """A recorder, once it is matched and its start is over."""
    bag = running.folder / f"bag{len(list(running.folder.glob('bag*')))}"
    node = running.start("recorder_node", f"bag:={bag}")
    keep_on(node.process.pid, others)
    while not (bag / "parameters.json").exists():
        time.sleep(0.05)
    return [node]


def viewer(running: Bench, problem: str, others: Sequence[int]) -> list[BenchProcess]:
    """A viewer, and who looks at it."""
    node = running.start("viewer_node", problem=problem)
    keep_on(node.process.pid, others)
    reader = running.run("reader", program(READER))
    reader.line()
    return [node, reader]


def monitor(running: Bench, problem: str, others: Sequence[int]) -> list[BenchProcess]:
    """`pdeloop monitor`, and an open page."""
    server = running.run("monitor", program("pdeloop", "monitor", "--port", "0"))
    while not (address := re.search(r"http://[\d.:]+/", server.line())):
        pass
    reader = running.run("reader", program(READER, address[0]))
    reader.line()
    return [server, reader]


COMPANY: dict[str, Callable[[Bench, str, Sequence[int]], list[BenchProcess]]] = {
    "recorder": recorder,
    "viewer": viewer,
    "monitor": monitor,
}
"""Starters of participants that come and go, off the cores of the pair as `pdeloop train` does it."""


def run(
    what: Literal["recorder", "viewer", "monitor"],
    *,
    problem: str = "burgers",
    windows: int = 6,
    seconds: float = 3.0,
) -> dict[str, Any]:
    """Measure the time of an iteration, and the processor time of plant and controller for it, with and
    without another process.

    Parameters
    ----------
    what
        The process that is started and stopped beside the loop.
    problem
        The problem of the loop.
    windows
        Number of windows without the process, and of windows with it.
    seconds
        Duration of a window.
    """
    times: tuple[list[float], list[float]] = ([], [])
    processor: tuple[list[float], list[float]] = ([], [])
    with bench() as running:
        cores = pair_cores(1)
        others = [core for core in usable_cores() if core not in cores]
        nodes = [
            running.start(node.package, *node.assignments, problem=problem)
            for node in pair_nodes(cores)
        ]
        folder = running.folder / "run"
        # The tuner's own share of the processor is small.
        given = (f"out:={folder}", "iterations:=100000", "optimizer:=two_point")
        running.start("tuner_node", *given, problem=problem)

        def observe(side: int) -> None:
            before = _processor_time(nodes)
            found = _iterations(folder, seconds)
            times[side].extend(found)
            processor[side].append((_processor_time(nodes) - before) / (len(found) + 1))

        while not any(row["event"] == "adapted" for row in progress(folder)):
            time.sleep(0.1)
        for _ in range(windows):
            observe(0)
            beside = COMPANY[what](running, problem, others)
            time.sleep(0.5)
            observe(1)
            for process in beside:
                process.end()
            time.sleep(0.5)
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


def _processor_time(nodes: Sequence[BenchProcess]) -> float:
    """Seconds of processor time that the nodes have used so far."""
    return sum(sum(node.processor_times().values()) for node in nodes)


def _iterations(folder: Path, seconds: float) -> list[float]:
    """Times of the iterations of the next `seconds`."""
    before = len(progress(folder))
    time.sleep(seconds)
    stamps = [row["time"] for row in progress(folder)[before:]]
    return [b - a for a, b in itertools.pairwise(stamps)]
