# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Methods at equal rollouts, one table per problem: `python -m benchmarks baselines STUDY ...`.

benchmarks/studies/STUDY.yaml is a study of the project's optimisers, and names the methods of others
(benchmarks/methods.py), which are further tasks of that study: it runs on all cores, and is interrupted
and continued. A budget counts every rollout before the closing evaluation, explorations and checks
among them.

Initial fields are split by the seeds that draw them: a method learns from those of its training's seed,
constants are chosen on the fields of `VALIDATION` after trainings of `TUNING_SEEDS`, and the tables are
about the fields of `TEST` after other trainings.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from benchmarks.limits import find
from benchmarks.methods import LIBRARIES, METHODS, measure
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.finished_run import interval
from pdeloop.messages.arrays import Array
from pdeloop.messages.controllers import CONTROLLERS
from pdeloop.messages.parameters import table as parameters
from pdeloop.messages.problem import load_parameters
from pdeloop.messages.spec import read_document
from pdeloop.study import Study
from pdeloop.study import run as carry_out
from pdeloop.study.executors import local_workers as pool
from pdeloop.study.results import RESULTS_FILE, reading

__all__ = ["run", "text"]

STUDIES = Path(__file__).parent / "studies"
TEST, VALIDATION = 0, 2024
"""Evaluation seeds, which draw the initial fields of the tables, and those that choose constants."""
TUNING_SEEDS = (100, 101, 102, 103)
BUDGETS = (20, 40, 80)
LOOKS = {
    "model-based": (CONTROLLERS["model_based"].colour, "-s"),
    "two-point": (CONTROLLERS["lqt_po"].colour, "-o"),
    "lqt": (CONTROLLERS["lqt"].colour, "--o"),
    "lqt-again": (CONTROLLERS["lqt"].colour, "-s"),
    "mpc": (CONTROLLERS["lqt"].colour, ":^"),
    "lqg": (CONTROLLERS["lqt"].colour, "-.v"),
    "cma-es": ("#009e73", "-o"),
    "ppo": ("#cc79a7", "-o"),
    "sac": ("#cc79a7", "--s"),
    "no-control": (CONTROLLERS["none"].colour, "-"),
}
"""Colour and line of a method in the figure: methods of one kind share the colour of its controller,
those of others have the two colours of Okabe and Ito that are left."""


def run(
    studies: Sequence[str] = ("burgers",),
    *,
    rollouts: Sequence[int] = BUDGETS,
    seeds: int | None = None,
    methods: Sequence[str] = (),
    settings: Sequence[str] = (),
    tune: Sequence[str] = (),
    folder: Path | None = None,
    processes: int | None = None,
    any_environment: bool = False,
    figure: Path | None = None,
) -> dict[str, Any]:
    """Compare methods on problems, at equal numbers of rollouts.

    Parameters
    ----------
    studies
        Names in benchmarks/studies, or YAML files like the ones there.
    rollouts
        Budgets: numbers of all rollouts before the evaluation.
    seeds
        Number of seeds; if not given, those of the study, or with --tune all seeds for tuning.
    methods
        Compare only these methods; all of the file if not given.
    settings
        Words NAME=JSON: parameters of the problem for all methods, like sensors=16.
    tune
        Words NAME=JSON: compare values of constants or parameters on the validation split, like
        sigma=[0.1,0.3].
    folder
        Folder of the runs; runs/baselines if not given.
    processes
        Number of trainings at the same time; one per core if not given.
    any_environment
        Also accept results of other versions or another processor, as `pdeloop study` does.
    figure
        Draw the costs against the rollouts to this file.

    Raises
    ------
    ValueError
        There is no such study or method, or a setting is not NAME=JSON.
    """
    folder = folder or Path("runs") / f"baselines{'-tuning' if tune else ''}"
    result: dict[str, Any] = {"limits": {}, "rows": []}
    for name in studies:
        study, entries = chosen(name, seeds, methods, settings, tune)
        place = folder / Path(name).stem
        for budget in rollouts:
            print(f"{name}, {budget} rollouts ...", file=sys.stderr, flush=True)
            own, tasks = with_methods(study, entries, budget)
            refuse_other_constants(place / str(budget), tasks)
            executor = partial(pool, processes)
            failures = carry_out(
                own, place / str(budget), executor, tasks=tasks, any_environment=any_environment
            )
            for failure in failures:
                print(f"failed: {failure.training}: {failure.reason}", file=sys.stderr)
        for problem, file in study.problems.items():
            result["limits"][problem] = limit(file, study.settings)
            for budget in rollouts:
                found = table(place / str(budget), problem, budget)
                result["rows"] += [{"problem": problem, **row} for row in found]
    if figure is not None:
        plot(result, figure)
    return result


def chosen(
    name: str,
    seeds: int | None,
    methods: Sequence[str],
    settings: Sequence[str],
    tune: Sequence[str],
) -> tuple[Study, dict[str, dict[str, Any]]]:
    """The study of that name, and the methods with their constants, as the words change them."""
    path = Path(name) if name.endswith(".yaml") else STUDIES / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(each.stem for each in STUDIES.glob("*.yaml")))
        raise ValueError(f"no study {path}; expected one of {known}, or a YAML file like theirs")
    content = read_document(path)
    entries = {**content["variants"], **content.pop("methods", {})}
    study = Study.of(content, path.parent)
    unknown = sorted(set(methods) - set(entries))
    if unknown:
        raise ValueError(f"no method {', '.join(unknown)}; expected some of {', '.join(entries)}")
    entries = {name: entries[name] for name in methods or entries}
    study = replace(study, settings={**study.settings, "evaluation_seed": TEST, **pairs(settings)})
    require_libraries(entries)
    if seeds is not None:
        study = replace(study, seeds=tuple(range(seeds)))
    if tune:
        entries = candidates(entries, pairs(tune))
        settings_ = {**study.settings, "evaluation_seed": VALIDATION}
        study = replace(study, seeds=TUNING_SEEDS[:seeds], settings=settings_)
    return study, entries


def require_libraries(labels: Iterable[str]) -> None:
    """ValueError if what a method needs is not installed, before anything runs."""
    for label in labels:
        library, extra = LIBRARIES.get(label.partition("+")[0], (None, ""))
        if library is not None and importlib.util.find_spec(library) is None:
            raise ValueError(
                f"{label} needs {library}: pip install 'pdeloop[{extra}]', or leave it out of --methods"
            )


def pairs(words: Sequence[str]) -> dict[str, Any]:
    """Parse NAME=JSON words."""
    found = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            found[name] = json.loads(value)
        except json.JSONDecodeError as error:
            raise ValueError(
                f"{word!r} is not a setting; expected NAME=JSON like sigma=0.1"
            ) from error
    return found


def candidates(
    entries: Mapping[str, Mapping[str, Any]], grid: Mapping[str, Sequence[Any]]
) -> dict[str, dict[str, Any]]:
    """Every method with every combination of the values of `grid`, by a name that says which.

    Examples
    --------
    >>> candidates({"mpc": {"gain": 0.0}}, {"steps": [5, 10]})
    {'mpc+steps-5': {'gain': 0.0, 'steps': 5}, 'mpc+steps-10': {'gain': 0.0, 'steps': 10}}
    """
    found = {}
    for name, table in entries.items():
        for values in itertools.product(*grid.values()):
            own = dict(zip(grid, values, strict=True))
            label = "+".join([name, *(f"{key}-{value}" for key, value in own.items())])
            found[label] = {**table, **own}
    return found


def with_methods(
    study: Study, entries: Mapping[str, Mapping[str, Any]], budget: int
) -> tuple[Study, dict[str, Any]]:
    """The study with these variants at a budget, and the tasks of those that are not trainings."""
    known = {spec.name for spec in parameters()}
    variants, tasks = {}, {}
    for label, table in entries.items():
        variants[label] = {name: value for name, value in table.items() if name in known}
        constants = {name: value for name, value in table.items() if name not in known}
        method = label.partition("+")[0]
        if method in METHODS:
            tasks[label] = partial(measure, method, constants)
        elif constants:
            raise ValueError(f"{method} has no constants {', '.join(constants)}")
    settings = {**study.settings, "rollouts": budget}
    return replace(study, variants=variants, settings=settings), tasks


def refuse_other_constants(folder: Path, tasks: Mapping[str, Any]) -> None:
    """ValueError if a result in the folder is that of a method with other constants."""
    for label, task in tasks.items():
        for name, result in kept_results(folder, label):
            known, wanted = result["constants"], task.args[1]
            if known != wanted:
                raise ValueError(
                    f"{name} in {folder} has constants {known}, not {wanted}; give another --folder"
                )


def kept_results(folder: Path, variant: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and result.json of each finished task of a variant, in the order of the seeds."""
    if not (folder / RESULTS_FILE).exists():
        return
    with reading(folder) as results:
        rows = results.rows("name, variant, seed", "costs IS NOT NULL")
        for row in sorted(rows, key=lambda row: int(row["seed"])):
            if row["variant"] == variant:
                yield row["name"], json.loads(results.files(row["name"])["result.json"])


def iqm(values: Array, axis: int = -1) -> Any:
    """The interquartile mean: of the middle half of the values.

    Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS
    2021 (rliable), whose stratified bootstrap is the plain one over the seeds for a single problem.

    Examples
    --------
    >>> float(iqm(np.array([0.0, 1.0, 3.0, 1e9])))
    2.0
    """
    return scipy.stats.trim_mean(values, 0.25, axis=axis)


def table(folder: Path, problem: str, budget: int) -> list[dict[str, Any]]:
    """A row for each method with results on a problem, the best first; `costs`: of the seeds."""
    found: dict[str, list[dict[str, Any]]] = {}
    with reading(folder) as kept:
        columns = "problem, variant, seed, costs, rollouts"
        for row in sorted(
            kept.rows(columns, "costs IS NOT NULL"), key=lambda row: int(row["seed"])
        ):
            if row["problem"] == problem:
                found.setdefault(row["variant"], []).append(row)
    rows = []
    for method, results in found.items():
        costs = np.array([json.loads(result["costs"])["adapted"][0] for result in results])
        means = costs.mean(axis=1)
        rows.append(
            {
                "budget": budget,
                "method": method,
                "rollouts": int(max(result["rollouts"] for result in results)),
                "seeds": len(results),
                "cost": float(iqm(means)),
                "interval": interval((means,), iqm),
                "costs": means.tolist(),
                "mean": float(means.mean()),
                "worst": float(means.max()),
                "diverged": int((costs >= DIVERGED_COST).any(axis=1).sum()),
            }
        )
    return sorted(rows, key=lambda row: row["cost"])


def limit(problem: str, settings: Mapping[str, Any]) -> float | None:
    """The cost of the best known inputs for each field; None: unknown."""
    # Fewer sensors or weaker actuators do not lower it.
    strong = {"sensors": 0, "sensor_delays": 1, "action_limit": 0.0}
    own = {**settings, **strong, "identification": "dmdc", "identification_attempts": 10}
    known = find(load_parameters(problem, own))
    return None if known is None else float(known.mean())


def one_line_each(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows in which methods that cost the same, for every budget and seed of a problem, are one.

    Examples
    --------
    >>> row = {"problem": "p", "budget": 20, "costs": [1.0]}
    >>> rows = [{**row, "method": "mpc"}, {**row, "method": "lqt-again"}]
    >>> [row["method"] for row in one_line_each(rows)]
    ['lqt-again, mpc']
    """
    costs: dict[tuple[str, str], dict[int, list[float]]] = {}
    for row in rows:
        costs.setdefault((row["problem"], row["method"]), {})[row["budget"]] = row["costs"]
    groups: list[list[tuple[str, str]]] = []
    for key, own in costs.items():
        for group in groups:
            if group[0][0] == key[0] and _same(costs[group[0]], own):
                group.append(key)
                break
        else:
            groups.append([key])
    names = {group[0]: ", ".join(sorted(method for _, method in group)) for group in groups}
    return [
        {**row, "method": names[row["problem"], row["method"]]}
        for row in rows
        if (row["problem"], row["method"]) in names
    ]


def _same(a: Mapping[int, Sequence[float]], b: Mapping[int, Sequence[float]]) -> bool:
    """True if costs agree but for rounding."""
    return a.keys() == b.keys() and all(
        len(a[budget]) == len(b[budget]) and np.allclose(a[budget], b[budget], rtol=1e-9, atol=0.0)
        for budget in a
    )


def text(result: Mapping[str, Any]) -> str:
    """A Markdown table for each problem, the method first that is the best after the last budget."""
    lines: list[str] = []
    for problem, bound in result["limits"].items():
        rows = [row for row in one_line_each(result["rows"]) if row["problem"] == problem]
        budgets = list(dict.fromkeys(row["budget"] for row in rows))
        cells = {(row["method"], row["budget"]): cell(row) for row in rows}
        last = {row["method"]: row["cost"] for row in rows}
        head = [problem, *(f"{budget} rollouts" for budget in budgets), "over the best known"]
        lines += ["", f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
        for method in sorted(last, key=lambda name: last[name]):
            shown = [method, *(cells.get((method, budget), "") for budget in budgets)]
            known = bound is not None and finished(last[method])
            shown.append(f"{100 * (last[method] / bound - 1):z.1f} %" if known else "-")
            lines.append(f"| {' | '.join(shown)} |")
        if bound is not None:
            lines.append(
                f"| best known inputs | {' | '.join([f'{bound:.4g}'] * len(budgets))} | 0 |"
            )
    return "\n".join(lines[1:])


def cell(row: Mapping[str, Any]) -> str:
    """A cost with its interval, or how many of the seeds diverged."""
    if not finished(row["cost"]):
        return f"diverged ({row['diverged']} of {row['seeds']})"
    cost, ends = number(row["cost"]), [number(end) for end in row["interval"] or ()]
    return cost if set(ends) <= {cost} else f"{cost} ({' to '.join(ends)})"


def number(value: float) -> str:
    """A cost, or that the rollouts diverged."""
    return f"{value:.4g}" if finished(value) else "diverged"


def finished(cost: float) -> bool:
    """True if no rollout that diverged counts in a mean cost."""
    return cost < 1e-3 * DIVERGED_COST


def plot(result: Mapping[str, Any], path: Path) -> None:
    """Cost against rollouts with the intervals, a panel a problem."""
    from matplotlib import rc_context

    from pdeloop.report.style import STYLE, panels, plain_log

    shown = [row for row in one_line_each(result["rows"]) if finished(row["cost"])]
    methods = list(dict.fromkeys(row["method"] for row in shown))
    with rc_context(STYLE):
        figure, axes = panels(len(result["limits"]), 3.2, 3.0, 4.6)
        for ax, (problem, bound) in zip(axes, result["limits"].items(), strict=True):
            for method in methods:
                own = [r for r in shown if (r["problem"], r["method"]) == (problem, method)]
                ends = np.array([r["interval"] or (r["cost"],) * 2 for r in own]).reshape(-1, 2)
                color, line = LOOKS.get(method.split(", ")[0].partition("+")[0], ("black", ":x"))
                x = [r["budget"] for r in own]
                ax.plot(x, [r["cost"] for r in own], line, ms=4, lw=1, color=color, label=method)
                ax.fill_between(x, *ends.T, alpha=0.15, lw=0, color=color)
            if bound is not None:
                ax.axhline(bound, color="0", ls=":", lw=1, zorder=0, label="best known inputs")
                ax.set_ylim(bottom=0.93 * bound)
            low, high = ax.get_ylim()
            plain_log(ax, high / max(low, 1e-9))
            ax.set_xscale("log", base=2)
            ticks = sorted({row["budget"] for row in shown})
            ax.set_xticks(ticks, [str(tick) for tick in ticks])
            ax.set_xlabel("rollouts")
            ax.set_title(problem)
        axes[0].set_ylabel("mean stage cost, test fields")
        axes[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        figure.savefig(path, bbox_inches="tight")
