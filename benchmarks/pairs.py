# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks pairs`: one training served by pairs on several hosts, some of which fail.

The hosts are network namespaces joined by veth (benchmarks.hosts). The tuner is on one, every pair
of plant and controller on another. With faults a relay sits between plant and controller, and in the
last run one pair is killed in the middle for good. Each result is compared, bit for bit, with that
of the training in one process.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.hosts import environment, hosts, on
from benchmarks.processes import (
    Bench,
    BenchError,
    BenchProcess,
    bench,
    ended_well,
    machine,
    progress,
    table,
)
from loop_interfaces.parameter_file import yaml_text
from pdeloop.in_process import LocalPair, train
from pdeloop.pairs import namespaces
from pdeloop.training_run import resolve
from tuner_node.build import build_training

PROBLEM = "burgers"
LOSS, DELAY = 0.01, 0.002
"""Share of lost messages, and largest delay in s."""
SEEDS = 4
"""Trainings side by side, so that there is an episode for each of four pairs."""
LIMIT = 600.0
"""Seconds after which a run is given up."""


def run(*, pairs: Sequence[int] = (1, 2, 4), iterations: int = 20) -> dict[str, Any]:
    """A row for each number of pairs, without and with faults, and one with a pair killed."""
    budget = {"iterations": iterations, "optimizer": "two_point"}
    values = resolve(PROBLEM, {**budget, "seeds": SEEDS, "evaluation_fields": 4})
    training = build_training(values)
    began = time.monotonic()
    train(training, LocalPair(values), lambda row: None)
    alone = time.monotonic() - began
    expected = training.policies()
    rows = []
    line = [f"loss:={LOSS}", f"delay:={DELAY}"]
    plans: list[tuple[int, list[str], bool]] = [(k, [], False) for k in pairs]
    plans += [(k, line, False) for k in pairs]
    if max(pairs) > 1:
        plans.append((max(pairs), line, True))
    for count, faults, kill in plans:
        row = serve(values, count, faults, kill, expected)
        rows.append({"pairs": count, "faults": bool(faults), "killed": kill, **row})
    return {
        "iterations": iterations,
        "in_process_seconds": alone,
        "machine": machine(),
        "rows": rows,
    }


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
            environment=environment(),
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


def text(result: dict[str, Any]) -> str:
    """A table of `result`."""
    columns = {
        "pairs": "pairs",
        "faults": "faults",
        "killed": "a pair killed",
        "seconds": "s",
        "repeated_episodes": "episodes repeated",
        "identical": "same bits",
    }
    return (
        f"{PROBLEM}, {result['iterations']} iterations of {SEEDS} seeds; faults: {LOSS:.0%} of the "
        f"messages lost, delayed by up to {1e3 * DELAY:g} ms; "
        f"in one process {result['in_process_seconds']:.1f} s\n{table(result['rows'], columns)}"
    )
