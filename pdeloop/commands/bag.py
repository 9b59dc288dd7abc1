# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop bag`: inspection and verification of recordings."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from pdeloop.commands import common
from pdeloop.messages.spec import ParameterError
from pdeloop.output import print_json


def add(commands: common.Commands) -> None:
    """The command `bag`."""
    bag = common.command(
        commands,
        "bag",
        None,
        help="inspect or verify a recorded bag",
        description="Inspect or verify a bag written by --record or recorder_node "
        "(docs/recording.md).",
        example="pdeloop bag info runs/burgers-20260101-120000-1",
    )
    actions = bag.add_subparsers(required=True, metavar="ACTION")
    info = common.command(
        actions,
        "info",
        _bag_info,
        help="list the topics and episodes of a bag",
        example="pdeloop bag info runs/burgers-20260101-120000-1",
    )
    verify = common.command(
        actions,
        "verify",
        _bag_verify,
        help="recompute a recording and compare it bit by bit",
        description="Recompute states, actions, costs, models and policies, and compare them to "
        "the bit. The exit code is 1 if anything differs or is missing, or nothing can be recomputed.",
        example="pdeloop bag verify runs/burgers-20260101-120000-1",
    )
    info.add_argument("bag", type=common.a_path, metavar="BAG", help="folder of a bag or of a run")
    verify.add_argument(
        "bag",
        type=common.a_path,
        metavar="BAG",
        nargs="+",
        help="folder of a bag, or of a run with all its bags",
    )
    verify.add_argument(
        "--parameters",
        type=common.a_path,
        metavar="FILE",
        help="take the parameters from this file, not from the bag: a run's parameters.yaml, or a "
        "bag's parameters.json",
    )
    common.add_own_code(verify)
    for action in (info, verify):
        common.add_json(action)


def _bag_info(options: argparse.Namespace) -> int:
    from pdeloop.bags.info import describe, info_text

    content = describe(options.bag)
    if options.json:
        print_json(content)
    else:
        print(info_text(content))
    return 0


def _bag_verify(options: argparse.Namespace) -> int:
    from pdeloop.bags.verify import recorded_parameters, verify

    common.allow_own_code(options)
    if known := recorded_parameters(*options.bag, parameters=options.parameters):
        common.refuse_other_code(options, *known)
    report = verify(*options.bag, parameters=options.parameters)
    if options.json:
        print_json(asdict(report))
    else:
        print(report.text())
    if not report.recomputed:
        why = "; ".join(report.notes) or "no episode is complete"
        raise ParameterError(f"nothing was recomputed, so nothing is verified: {why}")
    return 0 if report.good else 1
