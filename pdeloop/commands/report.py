# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop report`."""

from __future__ import annotations

import argparse

from pdeloop.commands import common
from pdeloop.messages.text import printable


def add(commands: common.Commands) -> None:
    """The command `report`."""
    report = common.command(
        commands,
        "report",
        _report,
        help="draw figures and write an HTML page of a run or a reproduction",
        description="Draw figures for a paper (PNG and SVG), and write one HTML page that needs no "
        "network.",
        example="pdeloop report runs/paper",
    )
    report.add_argument(
        "folder", type=common.a_path, metavar="DIR", help="folder of a finished run or reproduction"
    )
    common.add_own_code(report)
    report.add_argument(
        "--animate", action="store_true", help="also make the animation of `pdeloop animate`"
    )
    report.add_argument(
        "--out", type=common.a_path, metavar="DIR", help="folder of the report [DIR/report]"
    )


def _report(options: argparse.Namespace) -> int:
    from pdeloop.report.data import gather
    from pdeloop.report.page import report

    common.allow_own_code(options)
    data = gather(options.folder)
    common.refuse_other_code(options, *(one.first.values for one in data.problems))
    page = report(data, options.out, animate=options.animate)
    for sentence in data.missing:
        print(f"not shown: {printable(sentence)}")
    print(f"report in {page}")
    return 0
