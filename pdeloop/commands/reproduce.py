"""`pdeloop reproduce` and `pdeloop report`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from loop_interfaces.spec import ParameterError
from pdeloop.commands.common import (
    DEFAULTS,
    Commands,
    add_equation,
    add_problem,
    allow_equation,
    command,
)
from pdeloop.commands.study import add_execution, carry_out
from pdeloop.output import print_json

if TYPE_CHECKING:
    from rich.console import Console

    from pdeloop.study import Failure, Study


def add(commands: Commands) -> None:
    """The commands `reproduce` and `report`."""
    _add_reproduce(commands)
    _add_report(commands)


def _add_reproduce(commands: Commands) -> None:
    reproduce = command(
        commands,
        "reproduce",
        _reproduce,
        help="the paper's experiment: its four controllers and Gauss-Newton, several seeds, a table",
        description="For each problem and seed: no control, LQT, LQT-PO and pure PO of the paper, and "
        "Gauss-Newton, with the cost of every policy on the evaluation fields. Ctrl-C interrupts; "
        "--out DIR of an interrupted reproduction continues it.",
        example="pdeloop reproduce burgers kdv --seeds 6 --out runs/paper",
    )
    add = reproduce.add_argument
    add_problem(reproduce, "shipped names or YAML files [the paper's]", "problems", "*")
    add("--seeds", type=int, metavar="N", help="trainings of each problem, side by side [6]")
    add("--iterations", type=int, metavar="N", help="iterations of the adapt phase [40]")
    add("--seed", type=int, metavar="S", help="the first seed [0]")
    add(
        "--identification-attempts",
        type=int,
        metavar="N",
        help="exploratory episodes a seed may use until LQT beats no control; 1: the first, "
        f"unchecked, as in the paper [{DEFAULTS['identification_attempts'].default}]",
    )
    add_equation(reproduce)
    add_execution(reproduce)


def _add_report(commands: Commands) -> None:
    report = command(
        commands,
        "report",
        _report,
        help="figures and an HTML page of a run or a reproduction",
        description="Figures for a paper (PNG and SVG) and one HTML page that needs no network.",
        example="pdeloop report runs/paper",
    )
    report.add_argument(
        "folder", type=Path, metavar="DIR", help="folder of a finished run or reproduction"
    )
    add_equation(report)
    report.add_argument("--out", type=Path, metavar="DIR", help="[DIR/report]")


def _reproduce(options: argparse.Namespace) -> int:
    from pdeloop.reproduce.experiment import reproduction_in, study_of

    allow_equation(options)
    names = ("seeds", "iterations", "seed", "identification_attempts")
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    for name, value in given.items():
        DEFAULTS[name].check(value)
    if options.iterations == 0:
        raise ParameterError("--iterations is 0; expected a whole number of at least 1")

    def study_in(folder: Path) -> Study:
        there = reproduction_in(folder)
        return (
            there
            if there and not (options.problems or given)
            else study_of(options.problems, given)
        )

    return carry_out("reproduce", options, study_in, _show)


def _show(study: Study, folder: Path, failures: list[Failure], console: Console) -> None:
    from pdeloop.reproduce.table import rows_of, text
    from tuner_node.results import versions

    if failures:
        return
    rows = rows_of(study, folder)
    (folder / "table.json").write_text(json.dumps({"rows": rows, "versions": versions()}, indent=1))
    if console.stderr:  # the data alone go to stdout
        print_json({"folder": str(folder), "rows": rows})
        return
    console.print(text(rows), markup=False)
    console.print(f"results in {folder} (figures: pdeloop report {folder})", markup=False)


def _report(options: argparse.Namespace) -> int:
    from pdeloop.report.page import report

    allow_equation(options)
    page, missing = report(options.folder, options.out)
    for sentence in missing:
        print(f"not shown: {sentence}")
    print(f"report in {page}")
    return 0
