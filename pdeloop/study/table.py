# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The table and the figure of a study."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from pdeloop.finished_run import CONFIDENCE, field_means, interval, reduction
from pdeloop.messages.arrays import Array
from pdeloop.messages.controllers import CONTROLLERS
from pdeloop.output import aligned
from pdeloop.study.description import Study
from pdeloop.study.results import Results, is_worked_on, read_study, reading
from pdeloop.study.training import differences
from tuner_node.rollouts import EVALUATED

CAVEAT = (
    f"In brackets: {100 * CONFIDENCE:.0f} % percentile bootstrap over the seeds. The reduced model, "
    "and with it LQT's cost, varies strongly between seeds: with few seeds such an interval is wide, "
    "and still too narrow."
)
ABOVE = "A negative percentage means a cost above LQT."
MARK = "*"
"""Mark of results computed in other environments."""
AVERAGES = ("ratio of the means", "mean of the ratios")
"""Averages of the seeds' costs relative to LQT's: see `pdeloop.finished_run.Reduction`."""


def rows(study: Study, folder: Path) -> list[dict[str, Any]]:
    """`figures` of every problem and variant, from the trainings that are finished so far.

    `other_environments` says how those differ from most of the study in which some were carried out.
    """
    with reading(folder) as results:
        return table(study, finished(results))


def finished(results: Results) -> list[dict[str, Any]]:
    """What `table` takes of the trainings that are finished."""
    columns = "problem, variant, seed, costs, rollouts, environment"
    return [*results.rows(columns, "costs IS NOT NULL")]


def table(study: Study, finished: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The rows of a study's table, from those of its trainings."""
    found: dict[tuple[str, str], dict[int, tuple[Any, float]]] = {}
    environments: dict[tuple[str, str], Counter[str]] = {}
    for row in finished:
        key = row["problem"], row["variant"]
        found.setdefault(key, {})[row["seed"]] = json.loads(row["costs"]), row["rollouts"]
        environments.setdefault(key, Counter())[row["environment"]] += 1
    together = sum(environments.values(), Counter[str]())
    most = json.loads(together.most_common(1)[0][0]) if together else {}
    rows = []
    for problem in study.problems:
        for variant in study.variants:
            own = found.get((problem, variant), {})
            seeds = [own[seed] for seed in study.seeds if seed in own]
            if seeds:
                costs = {n: np.concatenate([np.array(c[n]) for c, _ in seeds]) for n in EVALUATED}
                others = {
                    differences(json.loads(each), most) for each in environments[problem, variant]
                }
                entries = figures(costs, [paid for _, paid in seeds])
                entries["other_environments"] = sorted(others - {""})
                rows.append({"problem": problem, "variant": variant, **entries})
    return rows


def figures(measured: Mapping[str, Array], rollouts: Sequence[float]) -> dict[str, Any]:
    """The figures of trainings over all their seeds, whose models may have different orders.

    measured: costs (S, fields) of the closing evaluation, by controller; rollouts (S,).

    Means are over the seeds without those in which a rollout of the closing evaluation diverged,
    which `diverged` counts; `interval` is the percentile bootstrap over the seeds, and
    `below_lqt_percent` the `pdeloop.finished_run.Reduction`.
    """
    means = {name: field_means(costs) for name, costs in measured.items()}
    adapted = means["adapted"]
    good = adapted[np.isfinite(adapted)]
    below = reduction(measured["adapted"], measured["lqt"])
    return {
        "seeds": len(adapted),
        "rollouts": float(np.mean(rollouts)),
        "cost_by_seed": [float(cost) if np.isfinite(cost) else None for cost in adapted],
        "none": _mean(means["none"]),
        "lqt": _mean(means["lqt"]),
        "cost": _mean(adapted),
        "interval": interval((good,), np.mean),
        "worst": float(good.max()) if good.size else None,
        "diverged": len(adapted) - len(good),
        "below_lqt_percent": None if below is None else asdict(below),
    }


def _mean(values: Array) -> float | None:
    good = values[np.isfinite(values)]
    return float(good.mean()) if good.size else None


def text(table: Sequence[Mapping[str, Any]]) -> str:
    """The table for a terminal."""
    costs = [("problem", "", "seeds", "rollouts", "no control", "LQT", "adapted", "worst", "lost")]
    below = [("below LQT, %", "", *AVERAGES)]
    for row in table:
        known = CONTROLLERS.get(row["variant"])
        mark = MARK * bool(row["other_environments"])
        name = row["problem"], (row["variant"] if known is None else known.name) + mark
        numbers = [cost_text(row[each]) for each in ("none", "lqt")]
        own = cost_text(row["cost"], row["interval"]), cost_text(row["worst"])
        counts = str(row["seeds"]), f"{row['rollouts']:.0f}"
        costs.append((*name, *counts, *numbers, *own, str(row["diverged"])))
        below.append((*name, *reduction_texts(row["below_lqt_percent"])))
    lost = "lost: seeds with a rollout that diverged, which are left out." * any(
        row["diverged"] for row in table
    )
    others = sorted({each for row in table for each in row["other_environments"]})
    return "\n".join(
        [
            *aligned(costs, 2),
            "",
            *aligned(below, 2),
            *([ABOVE] if any(above(row["below_lqt_percent"]) for row in table) else []),
            CAVEAT,
            *([lost] if lost else []),
            *(f"{MARK}: some trainings had {each}; the last bits may differ." for each in others),
            *(f"WARNING: {sentence}" for sentence in beside_no_control(table)),
        ]
    )


def above(found: Mapping[str, Any] | None) -> bool:
    """True if a share below LQT's cost, or an end of its interval, is in fact above it."""
    if found is None:
        return False
    intervals = [*(found["ratio_interval"] or ()), *(found["mean_interval"] or ())]
    return bool(min(found["ratio_of_means"], found["mean_of_ratios"], *intervals) < 0)


def beside_no_control(table: Sequence[Mapping[str, Any]]) -> list[str]:
    """Controllers no cheaper than no control, which a reduction against LQT does not show.

    A sentence for each LQT law and each adapted controller, or for its worst seed.
    """
    found = []
    for row in table:
        none = row["none"]
        if none is None:
            continue
        known = CONTROLLERS.get(row["variant"])
        name = row["variant"] if known is None else known.name
        for whose, cost, so in (
            ("LQT", row["lqt"], "; a reduction against it says little"),
            (name, row["cost"], ""),
            (f"{name} in its worst seed", row["worst"], ""),
        ):
            if cost is not None and cost >= none:
                found.append(
                    f"{row['problem']}: {whose} costs {cost_text(cost)}, at least as much as no "
                    f"control ({cost_text(none)}){so}."
                )
                if whose == name:
                    break
    return list(dict.fromkeys(found))


def cost_text(mean: float | None, between: Sequence[float] | None = None) -> str:
    """A mean cost, with its interval if there is one."""
    if mean is None:
        return "diverged"
    return f"{mean:.4g}" + (f" ({between[0]:.4g} to {between[1]:.4g})" if between else "")


def reduction_texts(found: Mapping[str, Any] | None) -> tuple[str, str]:
    """The ratio of the means and the mean of the ratios, each with its interval, in percent."""
    if found is None:
        return "diverged", "diverged"

    def one(value: float, between: Sequence[float] | None) -> str:
        return f"{value:z.1f}" + (f" ({between[0]:z.1f} to {between[1]:z.1f})" if between else "")

    return (
        one(found["ratio_of_means"], found["ratio_interval"]),
        one(found["mean_of_ratios"], found["mean_interval"]),
    )


def plot(table: Sequence[Mapping[str, Any]]) -> bytes:
    """Every seed's cost, and mean and interval of every variant, a panel a problem, as a PNG."""
    from matplotlib import rc_context

    from pdeloop.report.style import STYLE, panels

    problems = list(dict.fromkeys(row["problem"] for row in table))
    with rc_context(STYLE):
        figure, axes = panels(len(problems), 2.6, 3.0, 3.5)
        for ax, problem in zip(axes, problems, strict=True):
            own = [row for row in table if row["problem"] == problem]
            for place, row in enumerate(own):
                costs = np.array(row["cost_by_seed"], dtype=np.float64)
                ax.plot([place - 0.15] * len(costs), costs, "o", ms=3, color="0.6")
                if row["cost"] is not None:
                    low, high = row["interval"] or (row["cost"], row["cost"])
                    ax.vlines(place, low, high, color="C0")
                    ax.plot(place, row["cost"], "o", ms=4, color="C0")
            ax.set_xticks(range(len(own)), [row["variant"] for row in own], rotation=20)
            ax.set_xlim(-0.5, len(own) - 0.5)
            ax.set_title(problem)
        axes[0].set_ylabel("mean stage cost after adaptation")
        content = BytesIO()
        figure.savefig(content, format="png")
    return content.getvalue()


RECENT = 100
"""Trainings from whose times of ending the rate follows."""
SHOWN = 5
"""Failures that are named."""


def status(folder: Path) -> dict[str, Any]:
    """How far the study in `folder` is.

    Returns `total`, `finished` and `failed` trainings; the `workers_lost` and the trainings that have
    lost most, `deaths`; `running`: whether a process carries the study out; the `rate_per_minute` of
    the last trainings and the `minutes_left`, None where they are not known; `failures`, by training;
    the `rows` of the table so far. StudyError if there is no study.
    """
    study = read_study(folder)
    failures: dict[str, str] = {}
    deaths: Counter[str] = Counter()
    ended: list[float] = []
    with reading(folder) as results, results.unchanged():
        trainings = [*results.rows("name, ended, failure, deaths", "1")]
        known = finished(results)
    for row in trainings:
        deaths[row["name"]] = row["deaths"]
        if row["failure"] is not None:
            failures[row["name"]] = row["failure"]
        if row["ended"] is not None:
            ended.append(row["ended"])
    total = len(study.problems) * len(study.variants) * len(study.seeds)
    running = is_worked_on(folder)
    recent = ended[-RECENT:]
    rate = None
    if running and len(recent) > 1:
        rate = 60 * (len(recent) - 1) / max(time.time() - recent[0], 1e-3)
    return {
        "folder": str(folder),
        "total": total,
        "finished": len(ended) - len(failures),
        "failed": len(failures),
        "running": running,
        "rate_per_minute": rate,
        "minutes_left": None if rate is None else (total - len(ended)) / rate,
        "workers_lost": deaths.total(),
        "deaths": {name: count for name, count in deaths.most_common(SHOWN) if count},
        "failures": failures,
        "rows": table(study, known),
    }


def status_text(found: Mapping[str, Any]) -> list[str]:
    """The lines of a status for a terminal."""
    done = f"{found['finished']} of {found['total']} trainings are finished"
    failed = f", {found['failed']} failed" if found["failed"] else ""
    lines = [done + failed + ("" if found["running"] else "; no process is working on them")]
    if found["rate_per_minute"] is not None:
        left = found["minutes_left"]
        lines.append(f"{found['rate_per_minute']:.3g} a minute, {left:.0f} min left")
    if found["workers_lost"]:
        most = ", ".join(f"{name} {count}" for name, count in found["deaths"].items())
        lines.append(f"{found['workers_lost']} workers were lost, most by {most}")
    failures = [*found["failures"].items()]
    lines += [f"failed: {name}: {reason}" for name, reason in failures[:SHOWN]]
    if len(failures) > SHOWN:
        lines.append(f"and {len(failures) - SHOWN} more, which --json has")
    return lines
