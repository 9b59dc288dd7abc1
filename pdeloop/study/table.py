"""The table and the figure of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdeloop.finished_run import CONFIDENCE, Array, field_means, interval, load, reduction
from pdeloop.study.description import Study


def rows(study: Study, folder: Path) -> list[dict[str, Any]]:
    """The figures of every problem and variant, from the trainings in `folder` that are finished.

    Means are over the seeds without those in which a rollout of the closing evaluation diverged,
    which `diverged` counts; `interval` is the percentile bootstrap over the seeds.
    """
    found = []
    for problem in study.problems:
        for variant in study.variants:
            places = [folder / problem / variant / str(seed) for seed in study.seeds]
            runs = [load(place) for place in places if (place / "result.json").exists()]
            if not runs:
                continue
            costs = {
                name: np.concatenate([run.costs[name] for run in runs])
                for name in ("none", "lqt", "adapted")
            }
            means = {name: field_means(table) for name, table in costs.items()}
            good = means["adapted"][np.isfinite(means["adapted"])]
            below = reduction(costs["adapted"], costs["lqt"])
            found.append(
                {
                    "problem": problem,
                    "variant": variant,
                    "seeds": len(runs),
                    "missing": len(places) - len(runs),
                    "rollouts": float(np.mean([run.rollouts[0]["total"] for run in runs])),
                    "cost_by_seed": means["adapted"].tolist(),
                    "none": _mean(means["none"]),
                    "lqt": _mean(means["lqt"]),
                    "cost": _mean(means["adapted"]),
                    "interval": interval((good,), np.mean),
                    "worst": float(good.max()) if good.size else None,
                    "diverged": int(np.isnan(means["adapted"]).sum()),
                    "below_lqt_percent": None if below is None else below.ratio_of_means,
                }
            )
    return found


def _mean(values: Array) -> float | None:
    good = values[np.isfinite(values)]
    return float(good.mean()) if good.size else None


def text(table: Sequence[Mapping[str, Any]]) -> str:
    """The table for a terminal."""
    lines = [
        f"{'problem':<16}{'variant':<18}{'seeds':>6}{'rollouts':>10}{'no control':>12}{'LQT':>10}"
        f"{'adapted':>10}  {f'{100 * CONFIDENCE:.0f} % interval':<18}{'worst':>8}  diverged"
    ]
    for row in table:
        known = row["interval"]
        between = f"{known[0]:.4g} to {known[1]:.4g}" if known else ""
        cells = "".join(f"{_number(row[name]):>10}" for name in ("lqt", "cost"))
        lines.append(
            f"{row['problem']:<16}{row['variant']:<18}{row['seeds']:>6}{row['rollouts']:>10.0f}"
            f"{_number(row['none']):>12}{cells}  {between:<18}{_number(row['worst']):>8}"
            f"  {row['diverged']}"
        )
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "diverged" if value is None else f"{value:.4g}"


def plot(table: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Every seed's cost, and mean and interval of every variant, a panel a problem, as a PNG."""
    from matplotlib import rc_context

    from pdeloop.report.style import STYLE, panels

    problems = list(dict.fromkeys(row["problem"] for row in table))
    with rc_context(STYLE):
        figure, axes = panels(len(problems), 2.6, 3.0, 3.5)
        for ax, problem in zip(axes, problems, strict=True):
            own = [row for row in table if row["problem"] == problem]
            for place, row in enumerate(own):
                costs = row["cost_by_seed"]
                ax.plot([place - 0.15] * len(costs), costs, "o", ms=3, color="0.6")
                if row["cost"] is not None:
                    low, high = row["interval"] or (row["cost"], row["cost"])
                    ax.vlines(place, low, high, color="C0")
                    ax.plot(place, row["cost"], "o", ms=4, color="C0")
            ax.set_xticks(range(len(own)), [row["variant"] for row in own], rotation=20)
            ax.set_xlim(-0.5, len(own) - 0.5)
            ax.set_title(problem)
        axes[0].set_ylabel("mean stage cost after adaptation")
        figure.savefig(path)
