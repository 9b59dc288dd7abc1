# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop evaluate`."""

from __future__ import annotations

import argparse
import sys

from pdeloop.commands import common
from pdeloop.commands.settings import add_set, read_settings
from pdeloop.messages.spec import ParameterError
from pdeloop.output import print_json


def add(commands: common.Commands) -> None:
    """The command `evaluate`."""
    evaluate = common.command(
        commands,
        "evaluate",
        _evaluate,
        help="evaluate a run's policies on other initial fields",
        description="Roll out the plant of a finished run without control, with LQT and with the "
        "adapted policy, from the same initial fields, and print the mean stage costs.",
        example="pdeloop evaluate runs/burgers-20260101-120000-1 --fields 60 --seed 7",
    )
    evaluate.add_argument(
        "folder", type=common.a_path, metavar="DIR", help="folder of a finished run"
    )
    evaluate.add_argument("--fields", type=int, metavar="N", help="number of initial fields [10]")
    evaluate.add_argument(
        "--seed", type=int, default=0, metavar="S", help="seed of these fields [0]"
    )
    evaluate.add_argument(
        "--mean-field",
        action="store_true",
        help="start from the mean of the initial distribution instead of sampled fields",
    )
    add_set(evaluate, "change a parameter of the plant or the cost", trains=False)
    common.add_own_code(evaluate)
    common.add_json(evaluate, "print the costs as JSON: {controller: [[cost per field] per seed]}")


def _evaluate(options: argparse.Namespace) -> int:
    from pdeloop.evaluation import as_text, evaluate, outcome
    from tuner_node import narration

    if options.mean_field and options.fields is not None:
        raise ParameterError("--mean-field is one field: leave out --fields")
    fields = 10 if options.fields is None else options.fields
    common.DEFAULTS["evaluation_fields"].check(fields, "--fields")
    common.DEFAULTS["evaluation_seed"].check(options.seed, "--seed")
    changes = read_settings(options.set)
    run = common.finished_run(options)
    costs = evaluate(
        run, fields=fields, seed=options.seed, mean_field=options.mean_field, changes=changes
    )
    if options.json:
        print_json({name: table.tolist() for name, table in costs.items()})
    else:
        print(as_text(costs))
    summary = outcome(costs, run.seeds[0])
    for text in narration.warnings(summary):
        print(f"WARNING: {text}", file=sys.stderr)
    return narration.exit_code(summary)
