# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks general`: the benefit of a training on plants for which it was not tuned.

Every case of `benchmarks.families` is trained at each budget and seed, and compared on held-out fields
with no control, with its own first law, with the best affine law and with the best known inputs
(`--bounds`: `benchmarks.bounds`; kept in benchmarks/families/bounds.json). Finished trainings are kept
in a folder, so that an interrupted run continues where it stood. Constants of the method are chosen on
`--tuning` seeds; tables are about the others.

The family `process` has plants as users write them (`benchmarks.families.process`), compared with the
clipped affine law and the linear MPC of their exact linearisation (`benchmarks.families.references`).
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

import pdeloop
from benchmarks.bounds import evaluation_seeds
from benchmarks.families import process
from benchmarks.families.cases import CASES, PROCESS_CASES, Case
from benchmarks.families.references import reference_costs
from benchmarks.kept import kept_row, rows_of
from pdeloop.messages.files import read_json
from pdeloop.study.executors import processes

__all__ = ["run", "text"]

TABLE_SEEDS = 200
"""First seed of the trainings in a table, in whose basis the bounds are worked out."""
TUNING_SEEDS = 100
"""First seed of the trainings with which constants of the method may be chosen."""
EVALUATION = 2000
"""Evaluation seed of the held-out fields in a table; `TUNING` has others."""
TUNING_EVALUATION = 1000
AFFINE = "affine"
BOUNDS = Path(__file__).parent / "families" / "bounds.json"
EVERY_CASE = CASES | PROCESS_CASES
REFERENCES = {
    "affine": "best affine law",
    "limit": "best known",
    "lqr": "LQR of the linearisation",
    "mpc": "its linear MPC",
    "sindy": "MPC on SINDy, 20 rollouts",
}


def run(
    cases: Sequence[str] = (),
    *,
    seeds: int = 6,
    budgets: Sequence[int] = (20, 40),
    fields: int = 10,
    laws: Sequence[str] = (AFFINE,),
    family: Literal["fields", "process"] = "fields",
    tuning: bool = False,
    bounds: bool = False,
    jobs: int | None = None,
    folder: Path = Path("runs/general"),
    save: Path | None = None,
) -> dict[str, Any]:
    """Train on every held-out case, and compare first law, adapted law and best known inputs.

    Parameters
    ----------
    cases
        Names of cases, or beginnings of names; none: all cases.
    seeds
        Number of trainings of each case and budget.
    budgets
        Rollouts of a training, including explorations and checks.
    fields
        Number of held-out initial fields.
    laws
        Laws that each training adapts, in turn.
    family
        Fields with sharp and smooth features, or plants of process, flow and structure.
    tuning
        Use the seeds and held-out fields with which constants may be chosen.
    bounds
        First compute the best affine law and the best known inputs, and keep their costs.
    jobs
        Number of processes; one per core if not given.
    folder
        Folder in which finished trainings are kept.
    save
        JSON file to which all rows and bounds are written.
    """
    known_cases = CASES if family == "fields" else PROCESS_CASES
    if bounds and family == "process":
        raise ValueError("--bounds needs plants with exact gradients; leave it out for process")
    beginnings = tuple(word for word in cases if word not in known_cases)
    chosen = {
        name: case
        for name, case in known_cases.items()
        if not cases or name in cases or name.startswith(beginnings)
    }
    if not chosen:
        raise ValueError(
            f"no case begins with {' or '.join(cases)}; known: {', '.join(known_cases)}"
        )
    evaluation = TUNING_EVALUATION if tuning else EVALUATION
    first = TUNING_SEEDS if tuning else TABLE_SEEDS
    tasks = [
        (name, budget, seed, law)
        for name in chosen
        for law in laws
        for budget in budgets
        for seed in range(first, first + seeds)
    ]
    if bounds:
        with processes(jobs) as pool:
            for name, found in zip(chosen, pool.map(bound, chosen), strict=True):
                keep_bound(name, found)
                said = ", ".join(f"{key} {number(cost)}" for key, cost in found.items())
                print(f"{name}: {said}", file=sys.stderr, flush=True)
    work = partial(train, fields=fields, evaluation=evaluation)
    rows = rows_of(tasks, work, line, jobs=jobs, folder=folder)
    known = read_json(BOUNDS) if BOUNDS.exists() and not tuning else {}
    result = {"rows": rows, "bounds": {name: known[name] for name in chosen if name in known}}
    if save is not None:
        save.write_text(json.dumps(result, indent=1) + "\n")
    return result


def train(
    task: tuple[str, int, int, str], *, fields: int, evaluation: int, folder: Path
) -> dict[str, Any]:
    """One training; its costs on the held-out fields, or the error that ended it."""
    name, budget, seed, law = task
    label = f"{name}, {budget}, {seed}, {evaluation}, {fields}"
    label += f", {law}" if law != AFFINE else ""
    path = folder / f"{hashlib.sha256(label.encode()).hexdigest()[:16]}.json"

    def costs() -> dict[str, Any]:
        began = time.process_time()
        given: dict[str, Any] = {"rollouts": budget, "seed": seed, "evaluation_fields": fields}
        given |= {"law": law} if law != AFFINE else {}
        done = trained(EVERY_CASE[name], evaluation_seed=evaluation, **given)
        means = {key: done.costs[key][0].mean().item() for key in ("none", "lqt", "adapted")}
        by_field = {key: done.costs[key][0].tolist() for key in ("lqt", "adapted")}
        seconds = time.process_time() - began
        found = {**means, "by_field": by_field, "spent": done.rollouts[0], "seconds": seconds}
        if name in PROCESS_CASES:
            plant = process.PLANTS[PROCESS_CASES[name].plant]()
            found |= reference_costs(plant, evaluation_seeds(evaluation, fields), seed)
        return found

    task_row = {"case": name, "budget": budget, "seed": seed, "law": law}
    return kept_row(path, task_row, costs)


def line(rows: Sequence[Mapping[str, Any]]) -> str:
    """What is said of a training."""
    (row,) = rows
    cost = row.get("error") or number(row["adapted"])
    return f"{of_law(row)}, {row['budget']} rollouts, seed {row['seed']}: {cost}"


def of_law(row: Mapping[str, Any]) -> str:
    """The case of a training, with its law if that is not the affine one."""
    law = row.get("law", AFFINE)
    return str(row["case"]) if law == AFFINE else f"{row['case']}, {law}"


def trained(case: Case, **settings: Any) -> Any:
    """The finished run of a case."""
    return pdeloop.train(case.base or None, **case.parameters(), **settings)


def bound(name: str) -> dict[str, float]:
    """Costs of the best affine law and of the best inputs on the held-out fields of the table."""
    from benchmarks.bounds import bounds_of

    costs = bounds_of(CASES[name], TABLE_SEEDS, evaluation_seeds(EVALUATION, 10))
    return {key: float(f"{own.mean():.5g}") for key, own in costs.items()}


def keep_bound(name: str, found: Mapping[str, float]) -> None:
    """Write the bounds of a case next to those of the others."""
    known = read_json(BOUNDS) if BOUNDS.exists() else {}
    known[name] = dict(found)
    BOUNDS.write_text(json.dumps(dict(sorted(known.items())), indent=1) + "\n")


def summaries(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row for each case: means over the seeds, and the worst seed against its own first law."""
    found = []
    names = {of_law(row): row["case"] for row in result["rows"]}
    for named, name in names.items():
        own = [row for row in result["rows"] if of_law(row) == named]
        summary: dict[str, Any] = {"case": named, "group": EVERY_CASE[name].group}
        summary |= result["bounds"].get(name, {})
        good = [row for row in own if "error" not in row]
        summary["failed"] = len(own) - len(good)
        for budget in dict.fromkeys(row["budget"] for row in good):
            rows = [row for row in good if row["budget"] == budget]
            summary |= {key: rows[0][key] for key in REFERENCES if key in rows[0]}
            for key in ("none", "lqt", "adapted"):
                summary[f"{key} {budget}"] = float(np.mean([row[key] for row in rows]))
            summary[f"highest {budget}"] = max(row["adapted"] for row in rows)
            ratios = [row["adapted"] / row["lqt"] for row in rows]
            summary[f"ratios {budget}"] = ratios
            summary["worst"] = max([*ratios, summary.get("worst", -math.inf)])
        found.append(summary)
    return sorted(found, key=lambda each: -each.get("worst", math.inf))


def text(result: Mapping[str, Any]) -> str:
    """A Markdown table, what lost most against its own first law first; worst seeds in brackets."""
    budgets = list(dict.fromkeys(row["budget"] for row in result["rows"]))
    head = ["case", "no control", "first law", *(f"{budget} rollouts" for budget in budgets)]
    failed = any("error" in row for row in result["rows"])
    every = summaries(result)
    references = [key for key in REFERENCES if any(key in each for each in every)]
    head += [*(REFERENCES[key] for key in references), "adapted / first law, each seed"]
    head += ["failed"] if failed else []
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for each in every:
        known = [budget for budget in budgets if f"none {budget}" in each]
        cells = [each["case"]]
        cells += [number(each[f"{key} {known[0]}"]) if known else "-" for key in ("none", "lqt")]
        cells += [
            f"{number(each[f'adapted {budget}'])} ({number(each[f'highest {budget}'])})"
            if budget in known
            else "-"
            for budget in budgets
        ]
        cells += [number(each.get(key)) for key in references]
        ratios = each.get(f"ratios {known[0]}", ()) if known else ()
        cells += [" ".join(f"{ratio:.2f}" for ratio in ratios)]
        cells += [str(each["failed"] or "")] if failed else []
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def number(cost: float | None) -> str:
    """A cost, that a rollout diverged, or that there is none."""
    if cost is None:
        return "-"
    return f"{cost:.4g}" if cost < 1e6 else "diverged"
