# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks gate`: what trainings end at, beside the same trainings before a change.

Every row is a training of 20 rollouts on held-out fields: the 46 cases of `benchmarks.families`, the
paper's problems between few sensors, and what has limits or no model of whole rollouts. Costs before,
by seed, are kept in benchmarks/gate.json. A change of the method is kept where no row ends above the
range of its seeds by more than chance. Finished trainings are kept in a folder, so that an interrupted
run continues where it stood: a change needs a folder of its own.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.choices import KNOWN
from benchmarks.families.cases import Case
from benchmarks.general import EVALUATION, TABLE_SEEDS, number, trained
from benchmarks.kept import Row, kept_row, rows_of
from pdeloop.messages.files import read_json

__all__ = ["run", "text"]

BEFORE = Path(__file__).parent / "gate.json"
SENSED_SEEDS = 2000
"""First seed of trainings with few sensors."""
PAPER = ("burgers", "allen-cahn", "kdv")


@dataclass(frozen=True)
class Gated:
    """Trainings of a row: their case, what replaces its parameters, and their seeds."""

    case: Case
    given: Mapping[str, Any] = field(default_factory=dict)
    seeds: range = range(TABLE_SEEDS, TABLE_SEEDS + 2)


def gated() -> dict[str, Gated]:
    """The rows by name."""
    on = {"evaluation_seed": EVALUATION, "evaluation_fields": 10}
    six = range(TABLE_SEEDS, TABLE_SEEDS + 6)
    three = range(SENSED_SEEDS, SENSED_SEEDS + 3)
    found = {
        name: Gated(case, on, six) if name in PAPER else Gated(case, on)
        for name, case in KNOWN.items()
    }
    found["burgers, limit 0.5"] = Gated(KNOWN["burgers"], on | {"action_limit": 0.5})
    for name in PAPER:
        for sensors in (8, 16):
            for noise in (0.0, 0.03, 0.1):
                given = {"sensors": sensors, "measurement_noise": noise, "law": "extended_kalman"}
                row = f"{name}, {sensors} sensors, noise {noise:g}"
                found[row] = Gated(KNOWN[name], given, three)
    return found


def run(
    rows: Sequence[str] = (),
    *,
    seeds: int = 6,
    freeze: bool = False,
    jobs: int | None = None,
    folder: Path = Path("runs/gate"),
) -> list[Row]:
    """Train on every row, and compare the costs with those of the same trainings before.

    Parameters
    ----------
    rows
        Names of rows, or beginnings of names; none: all rows.
    seeds
        At most so many trainings of a row; it has two, three (few sensors) or six (burgers,
        allen-cahn and kdv).
    freeze
        Keep these costs as those before.
    jobs
        Number of processes; one per core if not given.
    folder
        Folder in which finished trainings are kept.
    """
    known = gated()
    beginnings = tuple(word for word in rows if word not in known)
    chosen = [
        n for n in known if not rows or n in rows or (beginnings and n.startswith(beginnings))
    ]
    if not chosen:
        raise ValueError(f"no row begins with {' or '.join(rows)}; known: {', '.join(known)}")
    tasks = [
        (name, seed) for i in range(seeds) for name in chosen for seed in known[name].seeds[i:][:1]
    ]
    found = rows_of(tasks, train, line, jobs=jobs, folder=folder)
    if freeze:
        before = _before()
        for row in found:
            if "error" not in row:
                before.setdefault(row["row"], {})[str(row["seed"])] = float(f"{row['adapted']:.5g}")
        BEFORE.write_text(json.dumps(before, indent=1) + "\n")
    return found


def train(task: tuple[str, int], *, folder: Path) -> Row:
    """One training of a row."""
    name, seed = task
    row = gated()[name]

    def costs() -> dict[str, float]:
        done = trained(row.case, rollouts=20, seed=seed, **row.given)
        return {key: done.costs[key][0].mean().item() for key in ("none", "lqt", "adapted")}

    path = folder / f"{name.replace(' ', '-')}-{seed}.json"
    return kept_row(path, {"row": name, "seed": seed}, costs)


def line(rows: Sequence[Mapping[str, Any]]) -> str:
    """What is said of a training."""
    (row,) = rows
    was = _before().get(row["row"], {}).get(str(row["seed"]))
    cost = row.get("error") or number(row["adapted"])
    return f"{row['row']}, seed {row['seed']}: {cost} (before {number(was)})"


def _before() -> dict[str, dict[str, float]]:
    return read_json(BEFORE) if BEFORE.exists() else {}


def text(rows: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table, losses first: costs by seed, and the change of their mean."""
    before = _before()
    lines = ["| row | no control | first law | before | now | change |", "|---" * 6 + "|"]
    found = []
    for name in dict.fromkeys(row["row"] for row in rows):
        own = [row for row in rows if row["row"] == name]
        costs = [row.get("adapted", math.inf) for row in own]
        was = [before.get(name, {}).get(str(row["seed"]), math.nan) for row in own]
        change = sum(costs) / sum(was) - 1.0
        cells = [name, *(number(own[0].get(key)) for key in ("none", "lqt"))]
        cells += [", ".join(map(number, was)), ", ".join(map(number, costs))]
        highest = max(before.get(name, {}).values(), default=math.inf)
        cells.append(
            f"{100 * change:+.1f} %" + (", above its range" if max(costs) > highest else "")
        )
        found.append((-change if change == change else math.inf, cells))
    lines += [f"| {' | '.join(cells)} |" for _, cells in sorted(found, key=lambda each: each[0])]
    lines += [f"{row['row']}, seed {row['seed']}: {row['error']}" for row in rows if "error" in row]
    return "\n".join(lines)
