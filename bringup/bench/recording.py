"""How much a recorder slows the loop: one training, a recorder beside it now and then.

    python -m bringup.bench.recording burgers --windows 8

The same three nodes run all the time and only the recorder comes and goes, so that what else the
machine does weighs on both sides alike. Prints the medians of the time of an iteration with and
without it, and their ratio; and the same of the processor time of plant and controller, which is
what remains comparable on a machine that is busy with other things.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import signal
import statistics
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from bringup.domain import own_domain
from bringup.supervisor import node_command
from loop_interfaces.isolation import loopback_environment
from loop_interfaces.problem import find_problem


def measure(
    problem: str, windows: int, seconds: float, options: Sequence[str]
) -> list[list[float]]:
    """[times without, times with] of single iterations in s, and the same of processor times.

    The processor time is that of plant and controller for one iteration, one value a window.
    """
    times: list[list[float]] = [[], [], [], []]
    with tempfile.TemporaryDirectory() as name, own_domain() as domain:
        folder = Path(name)
        environment = {
            **os.environ,
            **loopback_environment(),
            "ROS_DOMAIN_ID": str(domain),
            "ROS_LOG_DIR": name,
        }
        log = (folder / "log").open("wb")

        def start(node: str, *parameters: str) -> subprocess.Popen[bytes]:
            given = [word for p in parameters for word in ("-p", p)]
            own = ("--params-file", str(find_problem(problem))) if node != "recorder_node" else ()
            command = node_command(node, *own, *given)
            return subprocess.Popen(command, env=environment, stdout=log, stderr=log)

        run = folder / "run"
        nodes = [
            start("pde_sim_node"),
            start("controller_node"),
            start("tuner_node", f"out:={run}", "iterations:=100000"),
        ]
        progress = run / "progress.jsonl"

        def observe(beside: int) -> None:
            before = _processor_time(nodes[:2])
            found = _iterations(progress, seconds)
            times[beside] += found
            times[2 + beside].append((_processor_time(nodes[:2]) - before) / (len(found) + 1))

        try:
            while not (progress.exists() and '"iteration"' in progress.read_text()):
                time.sleep(0.1)
            for window in range(windows):
                observe(0)
                bag = folder / f"bag{window}"
                recorder = start("recorder_node", f"bag:={bag}", *options)
                nodes.append(recorder)
                while not (bag / "parameters.json").exists():  # matched, and start-up is over
                    time.sleep(0.05)
                time.sleep(0.5)
                observe(1)
                recorder.send_signal(signal.SIGINT)
                recorder.wait()
                time.sleep(0.5)
        finally:
            for process in nodes:
                process.kill()
                process.wait()
            log.close()
    return times


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


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description="How much a recorder slows the loop.")
    parser.add_argument("problem", nargs="?", default="burgers", help="name or file [burgers]")
    parser.add_argument("--windows", type=int, default=6, help="windows with and without [6]")
    parser.add_argument("--seconds", type=float, default=3.0, help="length of a window [3]")
    parser.add_argument("--set", action="append", default=[], help="the recorder's name:=value")
    options = parser.parse_args(arguments)
    without, beside, *processor = measure(
        options.problem, options.windows, options.seconds, options.set
    )
    off, on = statistics.median(without), statistics.median(beside)
    print(
        f"{options.problem}: median iteration {1e3 * off:.2f} ms without a recorder "
        f"({len(without)} iterations), {1e3 * on:.2f} ms with one ({len(beside)}), "
        f"ratio {on / off:.3f}"
    )
    off, on = (statistics.median(values) for values in processor)
    print(
        f"  processor time of plant and controller {1e3 * off:.2f} ms without, "
        f"{1e3 * on:.2f} ms with one, ratio {on / off:.3f}"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
