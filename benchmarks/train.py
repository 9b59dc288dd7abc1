# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks train`: a whole training over topics against the same one in one process.

The two take turns. Without start-up means: from the first reduced model to the end. The start-up
given for topics is from the command to the first reduced model, so it contains, besides the start
of all nodes, one exploratory episode.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.processes import (
    Bench,
    BenchError,
    bench,
    ended_well,
    machine,
    program,
    progress,
    table,
)
from pdeloop.supervisor import START

LIMIT = 600.0
"""Seconds after which a training is given up."""


def run(*, problem: str = "burgers", turns: int = 3, iterations: int = 40) -> dict[str, Any]:
    """Time a whole training, over topics and in one process.

    Parameters
    ----------
    problem
        The problem to train on.
    iterations
        Iterations of a training, of two rollouts each.
    turns
        Number of trainings in each way.
    """
    ways: dict[str, list[str]] = {"in-process": ["--in-process"], "topics": []}
    runs: dict[str, list[dict[str, Any]]] = {way: [] for way in ways}
    with bench() as running:
        for turn in range(turns):
            for way, words in ways.items():
                out = running.folder / f"{turn}-{way}"
                runs[way].append(_train(running, problem, iterations, out, words))
    ratios = {
        way: median(
            r["seconds"] / i["seconds"] for r, i in zip(own, runs["in-process"], strict=True)
        )
        for way, own in runs.items()
    }
    rows = [
        {
            "way": way,
            "seconds": median(r["seconds"] for r in own),
            "ratio": ratios[way],
            "startup_seconds": median(r["startup"] for r in own),
            **{
                kind: {node: max(r[kind].get(node, 0.0) for r in own) for node in own[0][kind]}
                for kind in ("megabytes", "growth")
            },
        }
        for way, own in runs.items()
    ]
    same = len({r["policy"] for own in runs.values() for r in own}) == 1
    return {
        "problem": problem,
        "iterations": iterations,
        "identical": same,
        "machine": machine(),
        "rows": rows,
    }


def _train(
    running: Bench, problem: str, iterations: int, out: Path, words: Sequence[str]
) -> dict[str, Any]:
    """Seconds, memory and policy of one training."""
    command = program("pdeloop", "train", problem, "--out", str(out), *words)
    # The optimiser that always has the same number of rollouts.
    options = ("--optimizer", "two_point", "--iterations", str(iterations))
    began = time.time()
    training = running.run("training", [*command, *options])
    memory: dict[str, list[float]] = {}
    while not ended_well(training):
        if time.time() - began > LIMIT:
            raise BenchError(f"a training took more than {LIMIT:g} s")
        for name, size in _memory(training.process.pid).items():
            memory.setdefault(name, []).append(size)
        time.sleep(0.2)
    stamps = [row["time"] for row in progress(out) if row["event"] in ("designed", "evaluated")]
    with np.load(out / "policy.npz") as arrays:
        policy = arrays["policy"].tobytes()
    return {
        "seconds": stamps[-1] - stamps[0],
        "startup": stamps[0] - began,
        "megabytes": {name: max(sizes) for name, sizes in memory.items()},
        # In the middle of its life a node has all it needs: what comes on top from there is growth.
        "growth": {name: sizes[-1] - sizes[len(sizes) // 2] for name, sizes in memory.items()},
        "policy": policy,
    }


def _memory(pid: int) -> dict[str, float]:
    """Resident megabytes of the nodes that process `pid` started."""
    found = {}
    with suppress(OSError):
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        for child in children:
            with suppress(OSError):
                words = Path(f"/proc/{child}/cmdline").read_text().split("\0")
                pages = int(Path(f"/proc/{child}/statm").read_text().split()[1])
                if START in words:
                    name = words[words.index(START) + 1]
                    found[name] = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    return found


def text(result: dict[str, Any]) -> str:
    """A table of `result`."""
    columns = {
        "way": "way",
        "seconds": "s without start-up",
        "ratio": "ratio",
        "startup_seconds": "s to the first model",
        "megabytes": "MB at most",
        "growth": "growth MB",
    }

    def sizes(values: dict[str, float]) -> str:
        return ", ".join(f"{k.removesuffix('_node')} {v:.0f}" for k, v in values.items())

    rows = [
        {**row, "megabytes": sizes(row["megabytes"]), "growth": sizes(row["growth"])}
        for row in result["rows"]
    ]
    same = "the same to the bit" if result["identical"] else "NOT the same"
    return f"{result['problem']}, {result['iterations']} iterations; policies are {same}\n" + table(
        rows, columns
    )
