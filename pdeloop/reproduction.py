# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The paper's experiment as a study: its three adapted controllers, on the paper's models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pdeloop.finished_run import FinishedRun, load_run, merged
from pdeloop.study.description import Study
from pdeloop.study.results import STUDY_FILE, read_study, reading

LEARNED = {
    "lqt_po": {"start": "lqt", "optimizer": "two_point"},
    "pure_po": {"start": "zero", "optimizer": "two_point"},
    "model_based": {"start": "lqt", "optimizer": "model_based"},
}
"""The adapted controllers, and how each is trained."""
PAPER = {"burgers": 28.0, "allen-cahn": 15.8, "kdv": 36.4}
"""Percent by which LQT-PO lies below LQT after 40 iterations, arXiv:2403.01005."""
DEFAULTS = {"seeds": 6, "iterations": 40, "seed": 0}
"""The paper's numbers."""


def study_of(problems: Sequence[str], options: Mapping[str, Any]) -> Study:
    """The experiment on these problems, the paper's if there are none.

    The paper counts iterations of two rollouts each, after exploration and check; `model_based`
    has that many rollouts with its explorations.
    """
    rest = {**DEFAULTS, **options}
    first, seeds, iterations = (rest.pop(name) for name in ("seed", "seeds", "iterations"))
    budgets = {"two_point": {"iterations": iterations}, "model_based": {"rollouts": 2 * iterations}}
    return Study.of(
        {
            "problems": list(problems) or list(PAPER),
            "seeds": list(range(first, first + seeds)),
            "settings": {"identification": "dmdc", **rest},
            "variants": {
                name: {**how, **budgets[how["optimizer"]]} for name, how in LEARNED.items()
            },
            "curves": True,
        }
    )


def reproduction_in(folder: Path) -> Study | None:
    """The reproduction in `folder`; None if it holds something else."""
    if not (folder / STUDY_FILE).exists():
        return None
    study = read_study(folder)
    return study if study.curves and set(study.variants) == set(LEARNED) else None


def runs_of(study: Study, folder: Path, problem: str) -> dict[str, FinishedRun]:
    """The finished runs of a problem over all seeds, by adapted controller."""
    with reading(folder) as results, TemporaryDirectory(prefix="pdeloop-") as place:

        def one(name: str) -> FinishedRun:
            run = load_run(results.extract(name, Path(place)))
            return replace(run, folder=folder / name)

        return {
            variant: merged([one(f"{problem}/{variant}/{seed}") for seed in study.seeds])
            for variant in LEARNED
        }


def beside_the_paper(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Compare LQT-PO with the paper's figure: a sentence for each problem that the paper has.

    rows: of a study's table.
    """
    averages = {"ratio of the means": "ratio_interval", "mean of the ratios": "mean_interval"}
    found = []
    for row in rows:
        paper, below = PAPER.get(row["problem"]), row["below_lqt_percent"]
        if row["variant"] != "lqt_po" or paper is None or below is None:
            continue
        start = f"{row['problem']}: the paper reports {paper:.1f} % below LQT for LQT-PO"
        if below["ratio_interval"] is None:
            found.append(f"{start}, over six seeds; one seed cannot be compared with that.")
            continue
        within = [name for name, key in averages.items() if below[key][0] <= paper <= below[key][1]]
        place = f"within the interval of the {' and that of the '.join(within)}"
        found.append(f"{start}, which lies {place if within else 'outside both intervals'} here.")
    return found
