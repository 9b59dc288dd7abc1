# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks choices`: how often the law that `model_based` returns is the wrong one.

A few trainings of each case give laws and a model. What the first law, the fractions of the way to
the improved one and no control cost from many fields that made none of them is measured on the plant
and on the model. From this table the choice is drawn again thousands of times: other fields for the
rollouts of the training, from which the rules of the product (`choose_fraction`, `choose`) take a
fraction and a law. The costs of all fields say whether that was right. Constants of the rules are
chosen on `--tuning` seeds.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import count as count_from
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pdeloop
from benchmarks.bounds import evaluation_seeds
from benchmarks.families.cases import CASES, Case
from pdeloop.in_process import LocalPair, train
from pdeloop.messages.arrays import Array
from pdeloop.messages.files import make_folder, write_atomically
from pdeloop.method.adapt.belief import Belief
from pdeloop.method.adapt.improve import (
    FRACTIONS,
    ModelBasedSettings,
    choose_fraction,
    left_out_costs,
)
from pdeloop.method.adapt.model_based import CLOSE
from pdeloop.method.adapt.verdict import ADAPTED, FIRST, NONE, Evidence, choose, mean_of
from pdeloop.method.models import affine_law
from pdeloop.method.models.base import saturated
from pdeloop.study.executors import processes
from tuner_node.batch import context_of
from tuner_node.build import build_training

__all__ = ["run", "text"]

SEEDS, TUNING_SEEDS = 300, 100
"""First seeds of the trainings of a table, and of those with which constants may be chosen."""
EVALUATION, TUNING_EVALUATION = 3000, 1000
"""Evaluation seeds of the fields."""
FAMILIES = (
    "burgers-modes, viscosity 1e-2",
    "allen-cahn-modes",
    "kdv-modes",
    "benjamin-ono",
    "kawahara",
)
PLATE = {
    "plant": "plate",
    "physical": {"nx": 8, "ny": 8, "across": 5, "up": 2, "growth": 0.5, "saturation": 0.1},
    "horizon": 30,
    "reduced_order": 12,
    "exploration_variance": 1.0,
}
"""The smallest one of `scale`, of which no model predicts whole rollouts."""
KNOWN = {**CASES, "reacting plate": Case("local steps", "", PLATE)}
OF_FRACTIONS = 2
"""Rows of a table before those of the fractions of the way: no control and the first law."""


@dataclass(frozen=True, eq=False)
class Table:
    """What laws cost from many fields.

    Attributes
    ----------
    true, model : (2 + F, N) arrays
        On the plant and on the model: no control, the first law, and F fractions of the way from
        the law to stay with to the improved one.
    left_out : (P, F, N) array
        On the model: these fractions of the way to the law of each part of the fields.
    returned : (N,) array
        On the plant: the law that the training returned.
    base, chosen : str
        The law to stay with, and the one that the training chose.
    known, judged, of_first : int
        Rollouts before the last improvement, of the final law, and of the first law alone.
    """

    true: Array
    model: Array
    left_out: Array
    returned: Array
    base: str
    chosen: str
    known: int
    judged: int
    of_first: int

    @classmethod
    def of(cls, kept: Mapping[str, Any]) -> Table:
        """From its attributes as JSON."""
        arrays = ("true", "model", "left_out", "returned")
        return cls(**{**kept, **{name: np.array(kept[name], dtype=float) for name in arrays}})

    @property
    def stays(self) -> int:
        """The row of the law to stay with."""
        return 1 if self.base == FIRST else 0


def run(
    cases: Sequence[str] = FAMILIES,
    *,
    seeds: int = 4,
    rollouts: int = 20,
    fields: int = 300,
    draws: int = 2000,
    tuning: bool = False,
    jobs: int | None = None,
    folder: Path = Path("runs/choices"),
) -> dict[str, Any]:
    """Train, and draw again and again the choice that each training makes between its laws.

    Parameters
    ----------
    cases
        Names of cases in benchmarks/families/cases.py, or `reacting plate`.
    seeds
        Number of trainings of each case.
    rollouts
        Rollouts of each training.
    fields
        Number of initial fields from which the cost of a law is known.
    draws
        Number of choices drawn for each training.
    tuning
        Use the seeds and fields with which constants may be chosen.
    jobs
        Number of processes; one per core if not given.
    folder
        Folder in which the tables of costs are kept.
    """
    if unknown := [name for name in cases if name not in KNOWN]:
        raise ValueError(f"no case {unknown[0]!r}; known: {', '.join(KNOWN)}")
    first = TUNING_SEEDS if tuning else SEEDS
    evaluation = TUNING_EVALUATION if tuning else EVALUATION
    tasks = [(name, seed) for name in cases for seed in range(first, first + seeds)]
    make_folder(folder)
    work = partial(
        measured, rollouts=rollouts, fields=fields, evaluation=evaluation, folder=folder.resolve()
    )
    rows: list[dict[str, Any]] = []
    began = time.monotonic()
    with processes(jobs) as pool:
        for (name, seed), table in zip(tasks, pool.map(work, tasks), strict=True):
            own = {"case": name, "seed": seed}
            rows.append(own | judged(table, draws, seed))
            print(
                f"{name}, seed {seed} ({len(rows)} of {len(tasks)}, "
                f"{time.monotonic() - began:.0f} s)",
                file=sys.stderr,
                flush=True,
            )
    return {"rows": rows, "draws": draws, "fields": fields, "rollouts": rollouts}


def judged(table: Table | None, draws: int, seed: int) -> dict[str, Any]:
    """The choices drawn from a table, or that there is none."""
    if table is None:
        return {"error": NO_MODEL}
    return judge(table, draws, seed)


NO_MODEL = "no choice was left to the verdict"


def measured(
    task: tuple[str, int], *, rollouts: int, fields: int, evaluation: int, folder: Path
) -> Table | None:
    """The table of a training; None where nothing was decided."""
    label = f"{task}, {rollouts}, {fields}, {evaluation}"
    path = folder / f"{hashlib.sha256(label.encode()).hexdigest()[:16]}.json"
    if not path.exists():
        table = table_of(*task, rollouts=rollouts, seeds=evaluation_seeds(evaluation, fields))
        kept = asdict(table) if table else {}
        lists = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in kept.items()}
        write_atomically(path, json.dumps(lists).encode())
    found = json.loads(path.read_text())
    if not found:
        return None
    return Table.of(found)


def table_of(name: str, seed: int, *, rollouts: int, seeds: Sequence[int]) -> Table | None:
    """Train on a case, and measure its laws from the fields of these seeds."""
    case = KNOWN[name]
    problem = pdeloop.problem(
        case.base or None, **case.parameters(), seed=seed, rollouts=rollouts, evaluation_fields=1
    )
    training, pair = build_training(problem.values), LocalPair(problem.values)
    train(training, pair, lambda row: None)
    optimizer, rows = training.optimizers[0], training.history
    state, law = optimizer.state(), training.laws()[0]
    belief, explored = Belief.of(state), training.explorations[0]
    assert explored is not None and training.target is not None
    known = explored, training.further[0], training.measured[0]
    context = context_of(training.settings, law, training.target, *known)
    numbers = count_from(1)

    def costs_of(K: Array, b: Array) -> Array:
        acts = saturated(affine_law(K, b), context.action_set)
        noise = 10**6 * next(numbers) + np.arange(len(seeds))  # of every rollout its own
        own = noise if context.noise else None
        found = pdeloop.rollout(pair.plant, acts, seeds, own, keep=False).costs
        return np.where(found.diverged_step < 0, found.mean, np.inf)

    if belief is None or "laws" not in state:
        return None
    loop = belief.loop(context)
    none, first = loop.no_control, loop.theta(training.starts()[0])
    base = first if state["safe"] else none
    improved, *parts = np.asarray(state["laws"], dtype=float)
    count = FRACTIONS
    laws = [none, first, *(base + i / count * (improved - base) for i in range(count + 1))]
    returned = loop.theta(optimizer.policy)

    def costs(theta: Array) -> Array:
        return costs_of(theta[:, :-1] @ context.U.T, loop.constant_feature * theta[:, -1])

    began = pdeloop.rollout(pair.plant, lambda k, z: np.zeros((len(z), len(none))), seeds)
    fields = np.ascontiguousarray(began.fields[0])
    left_out = [left_out_costs(loop, base, [part], fields) for part in parts]
    return Table(
        np.stack([costs(theta) for theta in laws]),
        np.stack([loop.costs(theta, fields) for theta in laws]),
        np.stack(left_out),
        costs(returned),
        FIRST if state["safe"] else NONE,
        str(rows[-1]["chosen"]),
        int(rows[-2]["rollouts"]),
        int(rows[-1]["rollouts"] - rows[-2]["rollouts"]),
        int(rows[0]["rollouts"]) - training.settings.explorations,
    )


def drawn_choice(
    table: Table, fields: NDArray[np.int64], settings: ModelBasedSettings
) -> tuple[str, int]:
    """What is chosen where the rollouts have these fields in turn, and the row of its law."""
    known, judging = fields[: table.known], fields[table.known :][: table.judged]
    part = np.arange(len(known)) % len(table.left_out)
    fraction, held_out = choose_fraction(table.left_out[part, :, known].T, settings.confidence)
    adapted, stays = OF_FRACTIONS + fraction, table.stays
    means = table.model[:, known].mean(axis=1)
    close = len(judging) > 1 and means[0] <= (1.0 + CLOSE) * means[adapted]
    own, on_none = (judging[:-1], judging[-1:]) if close else (judging, judging[:0])

    def evidence(row: int, rollouts: NDArray[np.int64]) -> Evidence:
        true, model = table.true[row, rollouts], table.model[row, rollouts]
        excess = (true - model)[np.isfinite(model) | ~np.isfinite(true)]
        change = held_out
        if row < OF_FRACTIONS:
            differences = table.model[row, fields] - table.model[stays, fields]
            change = mean_of(differences)
        return Evidence(change, np.where(np.isnan(excess), np.inf, excess), (change,))

    rows = {FIRST: 1, NONE: 0, ADAPTED: adapted}
    measured = {FIRST: known[-table.of_first :], NONE: on_none, ADAPTED: own}
    if fraction == 0:
        del measured[ADAPTED]
    found = {
        name: evidence(rows[name], rollouts)
        for name, rollouts in measured.items()
        if len(rollouts) or name == table.base
    }
    chosen = choose(found, table.base, settings.confidence).chosen
    return chosen, rows[chosen]


def judge(table: Table, draws: int, seed: int) -> dict[str, Any]:
    """Shares of the draws, and what the training itself chose.

    helped: said of the adapted law; wrong: of these, all draws counted, in truth it is worse than
    the law to stay with; missed: that law stays, and the whole way would cost less by more than 1 %;
    none_wrong: no control, which in truth is worse than the first law; change: the mean relative change
    of what the returned law costs, and worst the largest.
    """
    rng = np.random.default_rng([seed, table.known])
    truth = table.true.mean(axis=1)
    stays, count = truth[table.stays], table.true.shape[1]
    best = truth[OF_FRACTIONS:].min()
    settings = ModelBasedSettings()
    found = [
        drawn_choice(table, rng.permutation(count)[: table.known + table.judged], settings)
        for _ in range(draws)
    ]
    changes = np.array([truth[row] / stays - 1.0 for _, row in found])
    names = np.array([name for name, _ in found])
    returned = table.returned.mean()
    return {
        "helped": float(np.mean(names == ADAPTED)),
        "wrong": float(np.mean((names == ADAPTED) & (changes > 0.0))),
        "missed": float(np.mean((names == table.base) & (best < 0.99 * stays))),
        "none_wrong": float(np.mean((names == NONE) & (truth[0] > truth[1]))),
        "change": float(changes.mean()),
        "worst": float(changes.max()),
        "possible": float(best / stays - 1.0),
        "chosen": table.chosen,
        "own_change": float(returned / stays - 1.0),
        "own_wrong": bool(table.chosen == ADAPTED and returned > stays),
    }


def interval(rates: Sequence[float]) -> tuple[float, float]:
    """The 95 % interval of Wilson of the mean of as many rates of trainings.

    A rate between 0 and 1 varies between trainings no more than what is 0 or 1 with the same mean, so
    that this is no narrower than it has to be.

    >>> [round(end, 2) for end in interval([0.0] * 16)]
    [0.0, 0.19]
    """
    n, p, z = len(rates), float(np.mean(rates)), 1.96
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low, high = ((middle + sign * half) / (1 + z * z / n) for sign in (-1, 1))
    return max(low, 0.0), min(high, 1.0)


def text(result: Mapping[str, Any]) -> str:
    """A Markdown table: each family, and all together."""
    head = ["case", "trainings", "says helped", "and is worse", "stays, and 1 % is missed"]
    head += ["no control, wrongly", "change", "worst", "possible", "worse as trained"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    good = [row for row in result["rows"] if "error" not in row]
    groups = {name: [row for row in good if row["case"] == name] for name in _names(good)}
    for name, rows in [*groups.items(), ("all", good)]:
        if not rows:
            continue
        low, high = interval([row["wrong"] for row in rows])
        mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key in _MEANS}
        worst = max(row["worst"] for row in rows)
        cells = [name, str(len(rows)), f"{100 * mean['helped']:.0f} %"]
        cells += [f"{100 * mean['wrong']:.1f} % ({100 * low:.0f} to {100 * high:.0f})"]
        cells += [f"{100 * mean[key]:.0f} %" for key in ("missed", "none_wrong")]
        cells += [f"{100 * value:+z.1f} %" for value in (mean["change"], worst, mean["possible"])]
        cells += [f"{sum(row['own_wrong'] for row in rows)}"]
        lines.append(f"| {' | '.join(cells)} |")
    if lost := [f"{row['case']}, seed {row['seed']}" for row in result["rows"] if "error" in row]:
        lines.append(f"\n{NO_MODEL}: {'; '.join(lost)}.")
    return "\n".join(lines)


_MEANS = ("helped", "wrong", "missed", "none_wrong", "change", "possible")


def _names(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(row["case"] for row in rows))
