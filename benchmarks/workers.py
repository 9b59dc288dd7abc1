# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks workers`: wall time of a study against the number of its worker processes.

From one worker follow the time of every training and of the start, and from these what more workers
could reach: no less than the longest training, nor the sum divided by their number.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.processes import machine, table
from pdeloop.study import Study
from pdeloop.study import run as carry_out
from pdeloop.study.executors import processes


def run(
    *, problem: str = "burgers", seeds: int = 8, workers: Sequence[int] = (1, 2)
) -> dict[str, Any]:
    """A row for each number of workers, 1 among them.

    Parameters
    ----------
    problem
        Of the trainings.
    seeds
        How many trainings there are.
    workers
        Numbers of processes.
    """
    content = {"problems": [problem], "seeds": seeds, "settings": {"rollouts": 20}}
    study, rows = Study.of(content), []
    for count in sorted({1, *workers}):
        with TemporaryDirectory() as folder:
            ends: list[float] = []
            began = time.perf_counter()

            def tell(done: int, total: int, status: str, ends: list[float] = ends) -> None:
                ends += [time.perf_counter()] * (done - len(ends))

            failures = carry_out(study, Path(folder), partial(processes, count), tell=tell)
            if failures:
                raise RuntimeError(f"{failures[0].training}: {failures[0].reason}")
            seconds = time.perf_counter() - began
        if count == 1:
            # The first training also waits for the process; the others begin as the one before ends.
            lengths = [b - a for a, b in pairwise(ends)]
            total, longest = seconds, max(lengths)
        bound = max(longest, total / count)
        rows.append(
            {
                "workers": count,
                "seconds": seconds,
                "speed_up": total / seconds,
                "bound": total / bound,
            }
        )
    return {"problem": problem, "trainings": seeds, "machine": machine(), "rows": rows}


def text(result: dict[str, Any]) -> str:
    """A table of `result`."""
    columns = {"workers": "workers", "seconds": "s", "speed_up": "speed-up", "bound": "at most"}
    return (
        f"{result['trainings']} trainings of {result['problem']}, {result['machine']['cores']} cores\n"
        + table(result["rows"], columns)
    )
