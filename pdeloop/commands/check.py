# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop check`."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from pdeloop.commands.common import Commands, add_equation, add_json, allow_equation, command
from pdeloop.output import print_json

ROLES = ("plant", "controller", "tuner")
OF_A_NODE = {"n_a": 1, "patience": 10.0, "network": False}
"""The options that only the check of a node has, and their defaults."""
OF_A_FILE = ("equation", "picture")


def add(commands: Commands) -> None:
    """The command `check`."""
    check = command(
        commands,
        "check",
        _check,
        help="whether a problem can be trained on, or a node of yours keeps to the interface",
        description="Check a problem before training on it: halve the integration step, see whether "
        "the actuators reach the modes that are unstable at the target, explore once, say which order "
        "the data support and what the first law costs, and draw fields and supports. Exit code "
        "1 if anything is not as it should be. With plant, controller or tuner instead of a FILE: "
        "whether such a node of yours, alone in this ROS_DOMAIN_ID, keeps to docs/interfaces.md.",
        example="pdeloop check burgers --picture burgers.png",
    )
    check.add_argument(
        "problem",
        metavar="FILE",
        help="a problem's YAML file, or a shipped name; or plant, controller, tuner",
    )
    check.add_argument("--n-a", type=int, metavar="N", help="actuators of the node [1]")
    check.add_argument("--patience", type=float, metavar="S", help="seconds that it may take [10]")
    check.add_argument(
        "--network", action="store_true", default=None, help="also a node on another machine"
    )
    add_equation(check)
    check.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="draw initial fields, target and the actuators' supports to this .png",
    )
    add_json(check, "print the findings as JSON")


def _check(options: argparse.Namespace) -> int:
    of_a_node = options.problem in ROLES
    given = {name: getattr(options, name) for name in (*OF_A_NODE, *OF_A_FILE)}
    given = {name: value for name, value in given.items() if value is not None}
    if wrong := [name for name in given if (name in OF_A_NODE) != of_a_node]:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in wrong)
        what = "a problem's FILE" if of_a_node else f"a node ({', '.join(ROLES)})"
        options.refuse(f"leave out {flags}: only for the check of {what}")
    if of_a_node:
        from pdeloop.conformance.node import check_node

        found = check_node(options.problem, **{**OF_A_NODE, **given})
    else:
        from pdeloop.problem_check import check, draw
        from pdeloop.training_run import resolve

        values = resolve(options.problem, allow_equation(options))
        if options.picture is not None:
            draw(values, options.picture)  # before the check, which takes longer
        found = check(values)
    findings = []
    for finding in found:
        findings.append(finding)
        if not options.json:
            print(f"{'ok ' if finding.good else 'BAD'}  {finding.name}: {finding.text}", flush=True)
    if options.json:
        print_json([asdict(finding) for finding in findings])
    elif options.picture is not None:
        print(f"picture in {options.picture}")
    return 0 if all(finding.good for finding in findings) else 1
