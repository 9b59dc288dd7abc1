"""`pdeloop check`."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from loop_interfaces.spec import ParameterError
from pdeloop.commands.common import Commands, add_equation, add_json, allow_equation, command
from pdeloop.output import print_json


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
    check.add_argument("--n-a", type=int, default=1, metavar="N", help="actuators of the node [1]")
    check.add_argument(
        "--patience", type=float, default=10.0, metavar="S", help="seconds that it may take [10]"
    )
    check.add_argument("--network", action="store_true", help="also a node on another machine")
    add_equation(check)
    check.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="draw initial fields, target and the actuators' supports to this .png",
    )
    add_json(check, "print the findings as JSON")


def _check(options: argparse.Namespace) -> int:
    from pdeloop.problem_check import check, draw
    from pdeloop.training_run import resolve

    if options.problem in ("plant", "controller", "tuner"):
        from pdeloop.conformance.node import check_node

        if options.picture is not None:
            raise ParameterError("--picture is of a problem's file; leave it out")
        found = check_node(
            options.problem, n_a=options.n_a, patience=options.patience, network=options.network
        )
    else:
        values = resolve(options.problem, allow_equation(options))
        found = check(values)
    findings = []
    for finding in found:
        findings.append(finding)
        if not options.json:
            print(f"{'ok ' if finding.good else 'BAD'}  {finding.name}: {finding.text}", flush=True)
    if options.picture is not None:
        draw(values, options.picture)
    if options.json:
        print_json([asdict(finding) for finding in findings])
    elif options.picture is not None:
        print(f"picture in {options.picture}")
    return 0 if all(finding.good for finding in findings) else 1
