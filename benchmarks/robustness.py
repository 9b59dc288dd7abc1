"""`python -m benchmarks robustness`: trainings with noise, with action limits and with few sensors.

Every line of the tables is a training of `--seeds` seeds side by side in this process, as
`pdeloop train --in-process` does it, `--rollouts` a seed, judged on the same ten sampled fields.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from loop_interfaces.topics import COMPLETED
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.in_process import LocalPair, train
from pdeloop.training_run import resolve
from tuner_node.build import build_training
from tuner_node.training import Training

PROBLEMS = ("burgers", "allen-cahn", "kdv")
LOST = 1e-3 * DIVERGED_COST
"""A mean cost in which rollouts that diverged count."""
LEVELS: dict[str, list[dict[str, Any]]] = {
    "ideal": [{}],
    "measurement": [{"measurement_noise": level} for level in (0.01, 0.03, 0.1)],
    "process": [{"process_noise": level} for level in (0.003, 0.01, 0.03)],
    "limit": [{"action_limit": level} for level in (2.0, 1.0, 0.5)],
    "sensors": [
        {"sensors": sensors, "sensor_delays": delays}
        for sensors in (32, 16, 8)
        for delays in (1, 4)
    ],
    "both": [
        {"measurement_noise": level, "sensors": 64, "sensor_delays": delays}
        for level in (0.03, 0.1)
        for delays in (1, 4)
    ],
}
"""What is tried, by part."""


def run(
    problems: Sequence[str] = PROBLEMS,
    parts: Sequence[str] = tuple(LEVELS),
    seeds: int = 3,
    rollouts: int = 20,
) -> list[dict[str, Any]]:
    """One row for each problem and level."""
    rows = []
    for problem in problems:
        for part in parts:
            for options in LEVELS[part]:
                row = measure(problem, {**options, "seeds": seeds, "rollouts": rollouts})
                rows.append({"part": part, "options": options, **row})
                print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return rows


def measure(problem: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Costs of one setting: mean over the fields, one number a seed."""
    values = resolve(problem, dict(options))
    training = build_training(values)
    try:
        train(training, LocalPair(values), lambda _: None)
    except ValueError as error:  # no reduced model
        return {"problem": problem, "failed": str(error)}
    return {"problem": problem, **outcome(training)}


def outcome(training: Training) -> dict[str, Any]:
    """What a finished training says: costs a seed, attempts at a model, diverged rollouts."""
    assert training.evaluation is not None and training.ended is not None
    none, lqt, adapted = training.evaluation.mean(axis=2).T
    steps = [bool(row["accepted"]) for row in training.history if "accepted" in row]
    return {
        "none": none.tolist(),
        "lqt": lqt.tolist(),
        "adapted": adapted.tolist(),
        "attempts": [attempt + 1 for attempt in training.attempts],
        "accepted": [sum(steps), len(steps)],
        "diverged_rollouts": sum(int(row["diverged"]) for row in training.history),
        "diverged_final": int((training.ended[:, 2] != COMPLETED).sum()),
    }


def text(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as a Markdown table for each problem: mean over the seeds (worst seed).

    explorations: episodes a seed until a warm start beat no control; worse: seeds whose LQT law costs
    more than no control; accepted: steps of Gauss-Newton.
    """
    lines: list[str] = []
    for problem in dict.fromkeys(row["problem"] for row in rows):
        lines += ["", f"**{problem}**", ""]
        lines.append(
            "| setting | explorations | no control | LQT | worse | Gauss-Newton | accepted |"
        )
        lines.append("|---|---|---|---|---|---|---|")
        lines += [_line(row) for row in rows if row["problem"] == problem]
    return "\n".join(lines[1:])


def _line(row: Mapping[str, Any]) -> str:
    name = ", ".join(f"{key} {value:g}" for key, value in row["options"].items()) or "none of them"
    if "failed" in row:
        return f"| {name} | no reduced model | | | | | |"
    worse = sum(lqt >= none for lqt, none in zip(row["lqt"], row["none"], strict=True))
    cells = [name, "/".join(str(n) for n in row["attempts"]), f"{np.mean(row['none']):.4g}"]
    cells += [_cell(row["lqt"]), f"{worse} of {len(row['lqt'])}", _cell(row["adapted"])]
    return f"| {' | '.join(cells)} | {'/'.join(map(str, row['accepted']))} |"


def _cell(costs: Sequence[float]) -> str:
    lost = sum(cost >= LOST for cost in costs)
    if lost:
        return f"diverges ({lost} of {len(costs)})"
    return f"{np.mean(costs):.4g} ({max(costs):.4g})"
