# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop compare`."""

from __future__ import annotations

import argparse

from pdeloop.commands.common import Commands, a_path, add_json, command
from pdeloop.messages.spec import ParameterError
from pdeloop.output import print_json


def add(commands: Commands) -> None:
    """The command `compare`."""
    compare = command(
        commands,
        "compare",
        _compare,
        help="compare finished runs: their costs, and the parameters that differ",
        description="Show the costs of finished runs in one table, each adapted policy against "
        "that of the first run on the same initial fields, with a 95 percent bootstrap interval "
        "over the fields, and the parameters in which the runs differ. Where these change the "
        "plant, the cost or the fields, the costs are not compared, and the exit code is 1.",
        example="pdeloop compare runs/a runs/b",
    )
    compare.add_argument(
        "folders",
        type=a_path,
        metavar="RUN",
        nargs="+",
        help="folders of finished runs, two or more",
    )
    add_json(compare)


def _compare(options: argparse.Namespace) -> int:
    from pdeloop.comparison import SHOWN, compare
    from pdeloop.finished_run import load_run

    if len(options.folders) < 2:
        options.refuse("expected two runs or more")
    found = compare([load_run(folder) for folder in options.folders])
    if options.json:
        content = {"rows": found.rows(), "differing": found.differing, "apart": found.apart}
        print_json(content)
    else:
        print(found.text())
    if found.apart:
        raise ParameterError(
            f"the costs cannot be compared: the runs differ in {', '.join(found.apart[:SHOWN])}"
        )
    return 0
