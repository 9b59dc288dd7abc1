"""The closing table of a reproduction: costs, how far they lie below LQT's, the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from loop_interfaces.controllers import CONTROLLERS
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.finished_run import CONFIDENCE, FinishedRun, load, merged, reduction
from pdeloop.reproduce.experiment import LEARNED, PAPER
from pdeloop.study.description import Study

CAVEAT = (
    f"In brackets: {100 * CONFIDENCE:.0f} % percentile bootstrap over the seeds. The reduced model, "
    "and with it LQT's cost, varies much from seed to seed: with few seeds such an interval is wide, "
    "and still too narrow."
)


def runs_of(study: Study, folder: Path, problem: str) -> dict[str, FinishedRun]:
    """The finished runs of a problem over all seeds, by adapted controller."""
    return {
        name: merged([load(folder / problem / name / str(seed)) for seed in study.seeds])
        for name in LEARNED
    }


def rows_of(study: Study, folder: Path) -> list[dict[str, Any]]:
    """The figures of the table, a row for each problem.

    A controller's mean and standard deviation are over seeds and fields, without the rollouts that
    diverged, which are counted; the reductions are `pdeloop.finished_run.Reduction`.
    """
    return [row_of(problem, runs_of(study, folder, problem)) for problem in study.problems]


def row_of(problem: str, runs: Mapping[str, FinishedRun]) -> dict[str, Any]:
    """The row of a problem, from its runs by adapted controller; the first one's LQT law counts."""
    first = next(iter(runs.values())).costs
    costs = {"none": first["none"], "lqt": first["lqt"]}
    costs |= {name: run.costs["adapted"] for name, run in runs.items()}
    row: dict[str, Any] = {
        "problem": problem,
        "seeds": len(first["lqt"]),
        "paper_percent": PAPER.get(problem),
    }
    for name, own in costs.items():
        good = own[own < DIVERGED_COST]
        row[name] = {
            "mean": float(good.mean()) if good.size else None,
            "std": float(good.std()) if good.size else None,
            "diverged": int(own.size - good.size),
        }
        if name in runs:
            found = reduction(own, costs["lqt"])
            row[name]["below_lqt_percent"] = None if found is None else asdict(found)
    return row


def text(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table for a terminal."""
    shown = ("none", "lqt", *LEARNED)
    lines = [f"{'mean stage cost':<16}" + "".join(f"{CONTROLLERS[n].name:>16}" for n in shown)]
    for row in rows:
        cells = "".join(f"{cost_text(row[name]):>16}" for name in shown)
        lines.append(f"{row['problem']:<16}{cells}")
    if any(row[name]["diverged"] for row in rows for name in shown):
        lines.append("* without rollouts that diverged")
    lines += ["", f"{'below LQT, %':<32}{'ratio of the means':>26}{'mean of the ratios':>26}"]
    for row in rows:
        for name in LEARNED:
            ratio, mean = reduction_texts(row[name]["below_lqt_percent"])
            label = f"{row['problem']:<16}{CONTROLLERS[name].name:<16}"
            lines.append(f"{label}{ratio:>26}{mean:>26}")
    lines += [CAVEAT, *(sentence for row in rows if (sentence := beside_the_paper(row)))]
    return "\n".join(lines)


def cost_text(entry: Mapping[str, Any]) -> str:
    """Mean and standard deviation; a star where rollouts that diverged are left out."""
    if entry["mean"] is None:
        return "diverged"
    return f"{entry['mean']:.3g} ± {entry['std']:.2g}" + "*" * bool(entry["diverged"])


def reduction_texts(found: Mapping[str, Any] | None) -> tuple[str, str]:
    """The ratio of the means and the mean of the ratios, each with its interval, in percent."""
    if found is None:
        return "diverged", "diverged"

    def one(value: float, interval: Sequence[float] | None) -> str:
        return f"{value:.1f}" + (f" ({interval[0]:.1f} to {interval[1]:.1f})" if interval else "")

    return (
        one(found["ratio_of_means"], found["ratio_interval"]),
        one(found["mean_of_ratios"], found["mean_interval"]),
    )


def beside_the_paper(row: Mapping[str, Any]) -> str:
    """How LQT-PO's figure relates to the paper's; empty where the paper has none."""
    paper = row["paper_percent"]
    found = row.get("lqt_po", {}).get("below_lqt_percent")
    if paper is None or found is None:
        return ""
    start = f"{row['problem']}: the paper reports {paper:.1f} % below LQT for LQT-PO"
    if found["ratio_interval"] is None:
        return f"{start}, over six seeds; one seed cannot be compared with that."
    averages = {"ratio of the means": "ratio_interval", "mean of the ratios": "mean_interval"}
    within = [name for name, key in averages.items() if found[key][0] <= paper <= found[key][1]]
    place = f"within the interval of the {' and that of the '.join(within)}"
    return f"{start}, which lies {place if within else 'outside both intervals'} here."
