# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks hidden_noise`: trainings that are told less or more noise than there is.

The plant's readings are noisy, and the training gets another `measurement_noise`: none, a third of the
noise, three times as much, or, for comparison, the right one. Costs are those of the true field in the
closing evaluation. Finished trainings are kept in a folder, so that an interrupted run continues where
it stood.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pdeloop
from benchmarks.general import number
from benchmarks.kept import errors, kept_row, rows_of
from pde_sim_node.build import build_plant
from pdeloop.in_process import LocalPair
from pdeloop.in_process import train as train_here
from tuner_node.build import build_training
from tuner_node.results import summarise

__all__ = ["run", "text"]

Task = tuple[str, str, float, float, int]
"""Problem, optimizer, noise, its declared multiple and seed."""
CASE = ("problem", "optimizer", "noise", "told")
"""Entries of a row that seeds of one case have in common."""
RIGHT = 1.0
"""The multiple of the noise that is a right declaration."""


def run(
    problems: Sequence[str] = ("allen-cahn-modes", "kdv-modes", "burgers"),
    *,
    noise: Sequence[float] = (0.02, 0.05),
    told: Sequence[float] = (0.0, 1.0 / 3.0, RIGHT, 3.0),
    optimizers: Sequence[str] = ("model_based",),
    first: int = 2000,
    seeds: int = 2,
    rollouts: int = 20,
    jobs: int | None = None,
    folder: Path = Path("runs/hidden-noise"),
) -> list[dict[str, Any]]:
    """Train with noise that is declared wrongly or not at all.

    Parameters
    ----------
    problems
        Names of problems, or YAML files.
    noise
        Standard deviations of the noise of a reading.
    told
        Multiples of the noise that are declared; 0: none is declared.
    optimizers
        Names of optimisers.
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
    tasks = list(itertools.product(problems, optimizers, noise, told, own))
    work = partial(train, rollouts=rollouts)
    return rows_of(tasks, work, line, jobs=jobs, folder=folder)


def train(task: Task, *, rollouts: int, folder: Path) -> dict[str, Any]:
    """One training; its costs, the noise that it found, or the error that ended it."""
    problem, optimizer, noise, told, seed = task
    label = f"{Path(problem).stem}-{optimizer}-{noise:g}-{told:.3g}-{seed}-{rollouts}"
    case = {"problem": problem, "optimizer": optimizer, "noise": noise, "told": told, "seed": seed}

    def costs() -> dict[str, float]:
        given: dict[str, Any] = {"optimizer": optimizer, "rollouts": rollouts, "seed": seed}
        summary = trained(problem, noise, told * noise, given)
        found = {key: costs[0] for key, costs in summary["costs"].items()}
        return {**found, "found": summary["noise"]["found"][0]}

    return kept_row(folder / f"{label}.json", case, costs)


def trained(
    problem: str, noise: float, declared: float, given: Mapping[str, Any]
) -> dict[str, Any]:
    """The result of a training whose plant has this noise, while it is told another."""
    plant = build_plant(pdeloop.problem(problem, measurement_noise=noise, **given).values)
    values = pdeloop.problem(problem, measurement_noise=declared, **given).values
    training = build_training(values)
    train_here(training, LocalPair(values, plant), lambda row: None)
    return summarise(training)


def line(rows: Sequence[Mapping[str, Any]], right: Sequence[Mapping[str, Any]] = ()) -> str:
    """A row of the table from the trainings of one case, the seeds in their order.

    right: those with the right declaration.
    """
    one = rows[0]
    declared = f"{one['told'] * one['noise']:.2g}" if one["told"] else "none"
    cells = [one["problem"], one["optimizer"], f"{one['noise']:g}", declared]
    known = [row for row in rows if "error" not in row]
    cells.append(number(known[0]["none"]) if known else "-")
    for key in ("lqt", "adapted"):
        cells.append(", ".join(number(row.get(key)) for row in rows))
    cells.append(", ".join(number(row.get("adapted")) for row in right) or "-")
    found = (f"{row['found']:.2g}" if row.get("found") else "-" for row in rows)
    cells.append(", ".join(found))
    return f"| {' | '.join(cells)} |"


def text(rows: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table with a row for each wrong declaration, and the errors.

    Right ones are a column of it, and rows where there is nothing to compare them with.
    """
    head = ["problem", "optimizer", "noise", "declared", "no control", "first law", "adapted"]
    head += ["adapted, rightly declared", "noise found"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    cases: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        cases.setdefault(tuple(row[key] for key in CASE), []).append(row)
    lines += [line(own, cases.get((*case[:-1], RIGHT), ())) for case, own in cases.items()]
    return "\n".join(lines + errors(rows))
