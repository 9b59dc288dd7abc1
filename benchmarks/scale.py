# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks scale`: what a training costs as the state grows."""

from __future__ import annotations

import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import pdeloop
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import STATE

__all__ = ["run", "text"]

Row = dict[str, Any]
ORDER = 12
PROBLEM = """\
/**:
  ros__parameters:
    plant: plate
    physical: {{nx: {n}, ny: {n}, across: 5, up: 2, growth: 0.5, saturation: 0.1}}
    horizon: {steps}
    reduced_order: {order}
    exploration_variance: 1.0
"""


def run(
    states: Sequence[int] = (64, 1024, 4096, 16384, 65536),
    *,
    rollouts: int = 20,
    steps: int = 30,
    topics: bool = False,
) -> list[Row]:
    """Train a reacting plate with ten actuators on finer and finer grids, each in a process of its own.

    Parameters
    ----------
    states
        Sizes of the state: square numbers.
    rollouts
        Rollouts of a training.
    steps
        Steps of an episode, at least 22.
    topics
        Also train over topics, with a recording.
    """
    return [_measured(count, rollouts, steps, topics) for count in states]


def text(rows: list[Row]) -> str:
    """A table in Markdown."""
    names = list(rows[0])
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    lines += [f"| {' | '.join(f'{row[name]:.4g}' for name in names)} |" for row in rows]
    return "\n".join(lines)


def _measured(count: int, rollouts: int, steps: int, topics: bool) -> Row:
    n = math.isqrt(count)
    if n * n != count:
        raise ValueError(f"states must be squares, got {count}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        problem = folder / "plate.yaml"
        problem.write_text(PROBLEM.format(n=n, steps=steps, order=ORDER))
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
            row = alone.submit(_in_process, problem, rollouts, folder / "here").result()
        if topics:
            row |= _over_topics(problem, rollouts, folder)
        return row


def _in_process(problem: Path, rollouts: int, out: Path) -> Row:
    """Message, first model and training of one size; memory is that of this process."""
    known = pdeloop.problem(str(problem))
    plant = known.plant()
    values = plant.reset([0])
    codec, frame = STATE.codec(), Frame(1, 1, 0, 0.0, values)
    began = time.process_time()
    for _ in range(20):
        raw = codec.encode(frame)
        codec.decode(raw)
    message = (time.process_time() - began) / 20
    explored = known.explore(0)
    began = time.process_time()
    pdeloop.identify(explored, n_s=ORDER, constant=None)
    fit = time.process_time() - began
    began = time.process_time()
    found = pdeloop.train(str(problem), rollouts=rollouts, evaluation_fields=1, out=out)
    spent = time.process_time() - began
    costs = {name: found.costs[name].mean() / plant.n_z for name in ("none", "lqt", "adapted")}
    return {
        "states": plant.n_z,
        "message, kB": len(raw) / 1e3,
        "its coding, ms": 1e3 * message,
        "reduced model, s": fit,
        "training, s": spent,
        "cost per state, none": costs["none"],
        "first law": costs["lqt"],
        "adapted": costs["adapted"],
        "memory, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        "checkpoint, MB": (out / "checkpoint").stat().st_size / 1e6,
        "result.json, kB": (out / "result.json").stat().st_size / 1e3,
    }


def _over_topics(problem: Path, rollouts: int, folder: Path) -> Row:
    """The same training over topics: its time, its bag, and whether its policy is the same."""
    out, began = folder / "topics", time.monotonic()
    command = [sys.executable, "-m", "pdeloop", "train", str(problem), "--rollouts", str(rollouts)]
    command += ["--evaluation-fields", "1", "--record", "--out", str(out)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if not (out / "result.json").exists():
        raise RuntimeError(f"the training over topics failed: {done.stderr[-2000:]}")
    seconds = time.monotonic() - began
    policies = [np.load(at / "policy.npz")["policy"] for at in (folder / "here", out)]
    return {
        "over topics, s": seconds,
        "bag, MB": (out / "bag" / "bag.mcap").stat().st_size / 1e6,
        "same policy": int(np.array_equal(*policies)),
    }
