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

from benchmarks.processes import machine, markdown
from pdeloop.study import Study
from pdeloop.study import run as carry_out
from pdeloop.study.executors import processes


def run(
    problem: str = "burgers", seeds: int = 8, workers: Sequence[int] = (1, 2)
) -> dict[str, Any]:
    """A row for each number of workers; the first is 1."""
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
        rows.append({"workers": count, "seconds": seconds, "bound": max(longest, total / count)})
    return {"problem": problem, "trainings": seeds, "machine": machine(), "rows": rows}


def text(result: dict[str, Any]) -> str:
    """A table of `result`."""
    alone = result["rows"][0]["seconds"]
    rows = [
        (
            *(row["workers"], f"{row['seconds']:.1f}", f"{alone / row['seconds']:.2f}"),
            f"{alone / row['bound']:.2f}",
        )
        for row in result["rows"]
    ]
    head = ("workers", "s", "speed-up", "at most")
    return (
        f"{result['trainings']} trainings of {result['problem']}, {result['machine']['cores']} cores\n"
        + markdown(head, rows)
    )
