# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks few_sensors`: trainings with few sensors and noise, seed by seed.

Costs are those of the closing evaluation on ten held-out fields, the same for all seeds and for
`python -m benchmarks estimator`, which gives the bound. Finished trainings are kept in a folder, so
that an interrupted run continues where it stood.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from benchmarks.families.cases import case_of
from benchmarks.general import number, trained
from benchmarks.kept import errors, kept_row, rows_of
from pdeloop.method.adapt.verdict import mean_of

__all__ = ["run", "text"]

Task = tuple[str, int, float, str, int]
"""Problem, sensors, noise, law and seed."""


def run(
    problems: Sequence[str] = ("burgers", "allen-cahn", "kdv"),
    *,
    sensors: Sequence[int] = (8, 16),
    noise: Sequence[float] = (0.0, 0.03, 0.1),
    laws: Sequence[str] = ("extended_kalman",),
    first: int = 2000,
    seeds: int = 6,
    rollouts: int = 20,
    jobs: int | None = None,
    folder: Path = Path("runs/few-sensors"),
) -> list[dict[str, Any]]:
    """Train with few sensors.

    Parameters
    ----------
    problems
        Names of problems or of cases of `benchmarks.families`, or YAML files.
    sensors
        Numbers of sensors.
    noise
        Standard deviations of the noise of a reading.
    laws
        Names of laws.
    first
        First seed.
    seeds
        Number of trainings of each case.
    rollouts
        Rollouts of each training, including explorations and checks.
    jobs
        Number of processes; one per core if not given.
    folder
        Folder in which finished trainings are kept.
    """
    own = range(first, first + seeds)
    tasks = list(itertools.product(problems, sensors, noise, laws, own))
    work = partial(train, rollouts=rollouts)
    return rows_of(tasks, work, line, jobs=jobs, folder=folder)


def train(task: Task, *, rollouts: int, folder: Path) -> dict[str, Any]:
    """One training; its costs on the held-out fields, or the error that ended it."""
    problem, sensors, noise, law, seed = task
    label = f"{Path(problem).stem}-{sensors}-{noise:g}-{law}-{seed}-{rollouts}"
    row = {"problem": problem, "sensors": sensors, "noise": noise, "law": law, "seed": seed}

    def costs() -> dict[str, float]:
        case, given = case_of(problem), {"sensors": sensors, "measurement_noise": noise}
        done = trained(case, rollouts=rollouts, seed=seed, law=law, **given)
        return {key: done.costs[key][0].mean().item() for key in ("none", "lqt", "adapted")}

    return kept_row(folder / f"{label}.json", row, costs)


def line(rows: Sequence[Mapping[str, Any]]) -> str:
    """A row of the table from the trainings of one case, the costs of the seeds in their order."""
    one = rows[0]
    cells = [one["problem"], str(one["sensors"]), f"{one['noise']:g}", one["law"]]
    known = [row for row in rows if "error" not in row]
    cells.append(number(known[0]["none"]) if known else "-")
    for key in ("lqt", "adapted"):
        cells.append(", ".join(number(row.get(key)) for row in rows))
    cells.append(interval([row["adapted"] for row in known]))
    return f"| {' | '.join(cells)} |"


def interval(costs: Sequence[float]) -> str:
    """The mean of some trainings, with the 95 % interval of Student's t if there are several.

    >>> interval([1.0, 2.0, 3.0])
    '2 ± 2.484'
    """
    if len(costs) < 2:
        return "-"
    known = mean_of(np.array(costs))
    return f"{number(known.value)} ± {number(float(stdtrit(known.degrees, 0.975)) * known.error)}"


def text(rows: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table with a row for each case, and the errors."""
    head = ["problem", "sensors", "noise", "law", "no control", "first law", "adapted", "mean"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    cases: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        case = tuple(row[key] for key in ("problem", "sensors", "noise", "law"))
        cases.setdefault(case, []).append(row)
    lines += [line(own) for own in cases.values()]
    return "\n".join(lines + errors(rows))
