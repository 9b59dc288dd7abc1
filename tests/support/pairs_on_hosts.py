# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One training served by pairs on several hosts, some of which fail.

The hosts are network namespaces joined by veth (tests.support.hosts). The tuner is on one, every pair
of plant and controller on another. With faults a relay sits between plant and controller, and one pair
can be killed in the middle for good. The result is compared, bit for bit, with that of the training in
one process.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import Bench, BenchError, BenchProcess, bench, ended_well, progress
from pdeloop.messages.parameter_file import yaml_text
from pdeloop.pairs import namespaces
from tests.support.hosts import environment, hosts, on
from tests.support.interpreter import ROOT

LIMIT = 600.0
"""Seconds after which a run is given up."""


def serve(
    values: dict[str, Any],
    count: int,
    faults: Sequence[str],
    kill: bool,
    expected: NDArray[np.float64],
) -> dict[str, Any]:
    """One training over `count` pairs, each on a host; with `kill` the first one dies half-way."""
    with hosts(count + 1) as names, bench() as running:
        problem = running.folder / "problem.yaml"
        kept = {k: v for k, v in values.items() if k not in ("out", "resume", "pairs")}
        problem.write_text(yaml_text(kept))
        names_of_pairs = namespaces(count) if count > 1 else ["pair0"]
        nodes = [
            _pair(running, problem, name, namespace, faults, seed)
            for seed, (name, namespace) in enumerate(zip(names[1:], names_of_pairs, strict=True))
        ]
        out = running.folder / "run"
        tuner = running.start(
            "tuner_node",
            f"out:={out}",
            f"pairs:=[{', '.join(names_of_pairs)}]",
            problem=str(problem),
            prefix=on(names[0]),
            environment=environment(),
        )
        limit = time.monotonic() + LIMIT
        half = values["iterations"] * values["seeds"] // 2
        while not ended_well(tuner):
            if time.monotonic() > limit:
                raise BenchError(f"no end of a training over {count} pairs within {LIMIT:g} s")
            if kill and sum(row["event"] == "adapted" for row in progress(out)) >= half:
                for node in nodes[0]:
                    node.process.send_signal(signal.SIGKILL)
                kill = False
            time.sleep(0.05)
        rows = progress(out)
        stamps = [row["time"] for row in rows if row["event"] in ("designed", "evaluated")]
        with np.load(out / "policy.npz") as arrays:
            same = arrays["policy"].tobytes() == expected.tobytes()
        return {
            "seconds": stamps[-1] - stamps[0],
            "repeated_episodes": sum(row["event"] == "repeated" for row in rows),
            "identical": same,
        }


def _pair(
    running: Bench, problem: Path, host: str, namespace: str, faults: Sequence[str], seed: int
) -> list[BenchProcess]:
    def start(package: str, remap: str, *parameters: str) -> BenchProcess:
        return running.start(
            package,
            *parameters,
            problem=None if package == "tests.support.relay" else str(problem),
            namespace=namespace,
            prefix=on(host),
            # A node leaves the working directory out of its path, in which the relay is.
            environment=environment() | {"PYTHONPATH": str(ROOT)},
            remaps=[remap] if faults and remap else [],
        )

    clock = f"publish_clock:={str(seed == 0).lower()}"
    nodes = [
        start("pde_sim_node", "state:=state_sent", clock),
        start("controller_node", "action:=action_sent"),
    ]
    if faults:
        start("tests.support.relay", "", *faults, f"seed:={seed}")
    return nodes
