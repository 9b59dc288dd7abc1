# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop reproduce`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from pdeloop.commands import common
from pdeloop.commands.settings import add_set, read_settings
from pdeloop.commands.study import add_execution, carry_out
from pdeloop.messages.spec import ParameterError

if TYPE_CHECKING:
    from pdeloop.study import Study


def add(commands: common.Commands) -> None:
    """The command `reproduce`."""
    reproduce = common.command(
        commands,
        "reproduce",
        _reproduce,
        help="reproduce the paper's experiment over several seeds, and compare model_based with it",
        description="For each problem and seed, train the paper's LQT-PO and pure PO, and "
        "model_based, and compare them with LQT and no control on the same evaluation fields. Ctrl-C "
        "interrupts; --out DIR of an interrupted reproduction continues it.",
        example="pdeloop reproduce burgers kdv --seeds 6 --out runs/paper",
    )
    add = reproduce.add_argument
    common.add_problem(
        reproduce, "shipped names or YAML files [the paper's problems]", "problems", "*"
    )
    add("--seeds", type=int, metavar="N", help="number of trainings of each problem [6]")
    add("--iterations", type=int, metavar="N", help="iterations of the adapt phase [40]")
    add("--seed", type=int, metavar="S", help="the first seed [0]")
    add(
        "--identification-attempts",
        type=int,
        metavar="N",
        help="exploratory episodes a seed may use until LQT beats no control; 1: the first, "
        f"unchecked, as in the paper [{common.DEFAULTS['identification_attempts'].default}]",
    )
    add_set(reproduce, "any parameter, for all trainings")
    common.add_own_code(reproduce, ("equation", "plant"))

    add_execution(reproduce)


def _reproduce(options: argparse.Namespace) -> int:
    from pdeloop.reproduction import beside_the_paper, reproduction_in, study_of

    common.allow_own_code(options)
    names = ("seeds", "iterations", "seed", "identification_attempts")
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    for name, value in given.items():
        common.DEFAULTS[name].check(value)
    if options.iterations == 0:
        raise ParameterError("--iterations is 0; expected a whole number of at least 1")

    settings = read_settings(options.set)
    for name in names:
        if name in settings:
            raise ParameterError(f"--set {name}: give --{name.replace('_', '-')}, which sets it")

    def study_in(folder: Path) -> Study:
        there = None if options.problems or given or settings else reproduction_in(folder)
        return there or study_of(options.problems, given).having(settings)

    return carry_out("reproduce", options, study_in, beside_the_paper)
