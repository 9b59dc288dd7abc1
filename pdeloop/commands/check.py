# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop check`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict
from math import nan

from pdeloop.commands import common
from pdeloop.commands.settings import add_set, joined, read_settings
from pdeloop.messages.parameters import flags
from pdeloop.output import print_json

ROLES = ("plant", "controller", "tuner")
OF_A_NODE = {
    **dict.fromkeys(("n_a", "patience", "limit", "namespace", "network"), ROLES),
    "n_z": ("controller",),
}
"""The options that only the check of a node has, and of which."""
OF_A_FILE = ("equation", "plant", "optimizer", "law", "picture")


def add(commands: common.Commands) -> None:
    """The command `check`."""
    check = common.command(
        commands,
        "check",
        _check,
        help="check a problem before training, or a node of your own against the protocol",
        description="Check a problem before training on it: halve the integration step, see "
        "whether the actuators reach the modes that are unstable at the target, whether few sensors "
        "observe them and whether the plant diverges without control, explore once, report the order "
        "that the data support and the cost of the first law, and draw fields and supports. The exit "
        "code is 1 if a check fails. With plant, controller or tuner instead of a FILE, check that a "
        "node of your own, alone in this ROS_DOMAIN_ID, conforms to docs/stand-in.md.",
        example="pdeloop check burgers --picture burgers.png",
    )
    check.add_argument(
        "problem",
        nargs="?",
        default="",
        metavar="FILE",
        help="a problem's YAML file or shipped name, or one of plant, controller and tuner; not "
        "needed with --plant",
    )
    whole, real = _number(int, 1, 65536), _number(float, 0.1, 86400.0)
    add_option = check.add_argument_group("for the check of a node").add_argument
    add_option("--n-a", type=_number(int, 1, 1024), metavar="N", help="number of actuators [1]")
    add_option(
        "--n-z",
        type=whole,
        metavar="N",
        help="size of the state sent to a controller [64, then the order of its model]",
    )
    add_option("--patience", type=real, metavar="S", help="seconds to wait for an answer [10]")
    add_option(
        "--limit", type=real, metavar="S", help="seconds that the whole check may take [600]"
    )
    add_option("--namespace", metavar="NS", help="namespace of the node's topics")
    add_option(
        "--network", action="store_true", default=None, help="the node may run on another machine"
    )
    problem = check.add_argument_group("problem")
    common.add_own_code(problem)
    common.add_flags(problem, "problem")
    add_set(problem)
    check.add_argument(
        "--picture",
        type=common.a_path,
        metavar="FILE",
        help="draw initial fields, target and the actuators' supports to this .png",
    )
    common.add_json(check, "print the findings as JSON")


def _check(options: argparse.Namespace) -> int:
    if not options.problem and options.plant is None:
        options.refuse("give a problem's FILE, --plant NAME, or plant, controller or tuner")
    of_a_node = options.problem in ROLES
    of_the_problem = [spec.name for spec in flags("problem")]
    names = *OF_A_NODE, *OF_A_FILE, *of_the_problem
    given = {name: getattr(options, name) for name in names} | {"set": options.set or None}
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        takers = OF_A_NODE.get(name)
        if options.problem in takers if takers else not of_a_node:
            continue
        what = "a problem's FILE" if takers is None else f"a node ({', '.join(takers)})"
        options.refuse(
            f"--{name.replace('_', '-')} applies only to the check of {what}; leave it out"
        )
    if of_a_node:
        from pdeloop.conformance.node import check_node

        found = check_node(options.problem, **given)
    else:
        from pdeloop.problem_check import check
        from pdeloop.problem_picture import draw
        from pdeloop.training_run import load_compiled, resolve

        settings = joined(common.given_flags(options), read_settings(options.set))
        values = resolve(options.problem, settings | common.allow_own_code(options))
        if options.picture is not None:
            draw(values, options.picture)  # before the check, which takes longer
        load_compiled(values)
        found = check(values)
    findings = []
    for finding in found:
        findings.append(finding)
        if not options.json:
            mark = "BAD" if not finding.good else "note" if finding.note else "ok"
            print(f"{mark:4} {finding.name}: {finding.text}", flush=True)
    if options.json:
        print_json([asdict(finding) for finding in findings])
    elif options.picture is not None:
        print(f"picture in {options.picture}")
    return 0 if findings and all(finding.good for finding in findings) else 1


def _number(kind: type[int] | type[float], least: float, most: float) -> Callable[[str], float]:
    """A function that reads a number in a range, for argparse."""

    def read(text: str) -> float:
        try:
            number = kind(text)
        except ValueError:
            number = nan
        if not least <= number <= most:
            what = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(f"expected {what} from {least} to {most}, got {text}")
        return number

    return read
