# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks participants`: the cost of discovery among many idle nodes.

A tuner and K pairs of plant and controller, a process each, on the loopback interface only. They find
each other by multicast, or through Fast DDS's discovery server. Nobody computes: the tuner waits for
a recorder that does not come. Meanwhile it says in its log whom else it has not found.
"""

from __future__ import annotations

import re
import shutil
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from benchmarks.processes import BenchError, BenchProcess, bench, ended_well, machine, table
from pdeloop.messages.problem import config_folder
from pdeloop.pairs import PAIR, namespaces, ros_value

SERVER = "fast-discovery-server"
"""The program, which comes with Fast DDS."""
NODE_MEMORY = 0.12
"""GB of a node, for the check that all of them fit."""
GROUP = 5
"""Pairs that are started at the same time."""
LIMIT = 600.0
"""Seconds within which they have to be found."""
REPORT = 6.0
"""Seconds between two lines of the tuner on who is missing, at the most."""


def run(
    *,
    pairs: Sequence[int] = (1, 5, 10, 30),
    seconds: float = 20.0,
    discovery: Literal["multicast", "server"] = "multicast",
) -> dict[str, Any]:
    """Measure the memory and processor time of idle nodes, and of the machine before any is started.

    Parameters
    ----------
    pairs
        Numbers of pairs of plant and controller.
    seconds
        Duration over which processor time is measured.
    discovery
        How the nodes find each other.
    """
    names = namespaces(max(pairs))
    need, before = NODE_MEMORY * (2 * len(names) + 1), memory_available()
    if need > before:
        raise BenchError(
            f"{len(names)} pairs take about {need:.0f} GB of memory, and {before:.0f} GB are "
            "available; choose fewer with --pairs"
        )
    rows = []
    with bench() as running:
        if discovery == "server":
            command, address = server_command()
            running.run("discovery-server", command)
            running.environment["ROS_DISCOVERY_SERVER"] = address
        waiting = ["recorder:=required", f"pairs:={ros_value(names)}"]
        tuner = running.start("tuner_node", *waiting, problem="burgers")
        nodes = [tuner]
        for count in sorted({0, *pairs}):
            while (present := len(nodes) // 2) < count:
                for name in names[present : min(present + GROUP, count)]:
                    clock = f"publish_clock:={str(name == names[0]).lower()}"
                    for package, own in zip(PAIR, ([clock], []), strict=True):
                        nodes.append(
                            running.start(package, *own, problem="burgers", namespace=name)
                        )
                _wait_until_found(tuner, nodes)
            processors = _processors(nodes, seconds)
            time.sleep(REPORT)
            rows.append(
                {
                    "pairs": count,
                    "participants": len(nodes),
                    "lost": len(_missing(tuner, count)),
                    "memory": sum(map(_memory, nodes)),
                    **processors,
                }
            )
    return {"machine": machine(), "available": before, "seconds": seconds, "rows": rows}


def server_command() -> tuple[list[str], str]:
    """The command of a discovery server on a free port of loopback, and its address for the nodes.

    Raises
    ------
    BenchError
        There is no such program, neither next to Python nor on the path.
    """
    beside = str(Path(sys.executable).parent)
    program = shutil.which(SERVER, path=beside) or shutil.which(SERVER)
    if program is None:
        raise BenchError(
            f"expected the program {SERVER} next to Python or on the path, found none; install Fast "
            "DDS's tools, or choose --discovery multicast"
        )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    profile = config_folder() / "fastdds_discovery_server.xml"
    # Otherwise it also opens shared memory, which nobody uses and which stays when it is killed.
    without_memory = ["env", "FASTDDS_BUILTIN_TRANSPORTS=UDPv4"]
    where = ["-l", "127.0.0.1", "-p", port, "-x", str(profile)]
    return [*without_memory, program, "-i", "0", *where], f"127.0.0.1:{port}"


def _wait_until_found(tuner: BenchProcess, nodes: Sequence[BenchProcess]) -> None:
    limit = time.monotonic() + LIMIT
    time.sleep(REPORT)
    while missing := _missing(tuner, len(nodes) // 2):
        if time.monotonic() > limit:
            raise BenchError(f"not found within {LIMIT:.0f} s: {', '.join(missing)}")
        for node in nodes:
            ended_well(node)
        time.sleep(REPORT)


def _missing(tuner: BenchProcess, pairs: int) -> list[str]:
    """Whom of the first pairs the tuner has not found, by its newest line."""
    lines = [line for line in tuner.log().splitlines() if "waiting for" in line]
    if not lines:
        return ["tuner"]
    words = re.findall(r"(plant|controller) of pair (\d+)", lines[-1])
    return [f"{node} of pair {number}" for node, number in words if int(number) < pairs]


def _processors(nodes: Sequence[BenchProcess], seconds: float) -> dict[str, float]:
    """Cores that all nodes keep busy together: their own threads, and those of the middleware."""

    def used() -> dict[str, float]:
        times = [node.processor_times() for node in nodes]
        return {name: sum(own[name] for own in times) for name in times[0]}

    before, start = used(), time.monotonic()
    time.sleep(seconds)
    after, passed = used(), time.monotonic() - start
    return {name: (after[name] - before[name]) / passed for name in before}


def _memory(node: BenchProcess) -> float:
    """GB of a node; what it shares with others counts in parts (PSS, Linux)."""
    return _gigabytes("Pss", Path(f"/proc/{node.process.pid}/smaps_rollup"))


def memory_available() -> float:
    """GB that new processes could have (Linux)."""
    return _gigabytes("MemAvailable", Path("/proc/meminfo"))


def _gigabytes(name: str, file: Path) -> float:
    found = re.search(rf"^{name}:\s+(\d+) kB", file.read_text(), re.MULTILINE)
    assert found
    return int(found[1]) * 1024 / 1e9


def text(result: dict[str, Any]) -> str:
    """A table of `result`."""
    columns = {
        "pairs": "pairs",
        "participants": "participants",
        "lost": "not found",
        "memory": "memory, GB",
        "own": "cores busy: nodes",
        "middleware": "cores busy: middleware",
    }
    return (
        f"{result['machine']['cores']} cores, {result['available']:.1f} GB available before; means "
        f"over {result['seconds']:.0f} s\n{table(result['rows'], columns)}"
    )
