"""The paper's experiment as a study: its three adapted controllers, on the paper's models.

DIR is the folder of a study with curves (pdeloop.study.run), and with it

DIR/table.json    the figures of the table (pdeloop.reproduce.table)
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pdeloop.study.description import Study, StudyError
from pdeloop.study.run import ASKED, kept

LEARNED = {
    "lqt_po": {"start": "lqt", "optimizer": "two_point"},
    "pure_po": {"start": "zero", "optimizer": "two_point"},
    "gauss_newton": {"start": "lqt", "optimizer": "gauss_newton"},
}
"""The adapted controllers, and how each is trained."""
PAPER = {"burgers": 28.0, "allen-cahn": 15.8, "kdv": 36.4}
"""Percent by which LQT-PO lies below LQT after 40 iterations, arXiv:2403.01005."""
DEFAULTS = {"seeds": 6, "iterations": 40, "seed": 0}
"""As the paper."""


def study_of(problems: Sequence[str], options: Mapping[str, Any]) -> Study:
    """The experiment on these problems, the paper's if there are none.

    The paper counts iterations of two rollouts each, after exploration and check; Gauss-Newton has
    that many rollouts with exploration and check.

    Raises
    ------
    StudyError
        A problem is not there, or two have the same name.
    """
    rest = {**DEFAULTS, **options}
    first, seeds, iterations = (rest.pop(name) for name in ("seed", "seeds", "iterations"))
    budgets = {
        "two_point": {"iterations": iterations},
        "gauss_newton": {"rollouts": 2 * iterations},
    }
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
    """The reproduction in `folder`; None if it holds something else.

    Raises
    ------
    StudyError
        It is one that an older version began, or the study there cannot be read.
    """
    if (folder / "reproduction.json").exists():
        raise StudyError(
            f"{folder} holds a reproduction of an older version, which this one cannot read or "
            "continue; make it again in another folder with: pdeloop reproduce --out DIR"
        )
    if not (folder / ASKED).exists():
        return None
    study = kept(folder)
    return study if study.curves and set(study.variants) == set(LEARNED) else None


def command_of(study: Study) -> str:
    """The command that gives a reproduction."""
    options = {
        "seeds": len(study.seeds),
        "iterations": study.variants["lqt_po"]["iterations"],
        "seed": study.seeds[0],
        **{name: value for name, value in study.settings.items() if name != "identification"},
    }
    words = [word for k, v in options.items() for word in (f"--{k.replace('_', '-')}", str(v))]
    return shlex.join(["pdeloop", "reproduce", *study.problems.values(), *words])
