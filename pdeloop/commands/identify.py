# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop identify`."""

from __future__ import annotations

import argparse
import sys

from loop_interfaces.parameters import IDENTIFICATION
from loop_interfaces.spec import ParameterError
from pdeloop.commands.common import Commands, a_path, add_json, command
from pdeloop.output import print_json


def add(commands: Commands) -> None:
    """The command `identify`."""
    identify = command(
        commands,
        "identify",
        _identify,
        help="reduced model from recorded episodes or own measurements",
        description="Identify a reduced model by least squares in reduced coordinates, design "
        "LQ-tracking gains, and show which order the data support: singular values, and errors on "
        "held-out steps. From the exploratory episodes of a bag (all episodes if none is), of this "
        "plant or a foreign one, or from measurements in a file.",
        example="pdeloop identify --data examples/measurements.csv --out model.npz",
    )
    source = identify.add_mutually_exclusive_group(required=True)
    source.add_argument("--bag", type=a_path, metavar="BAG", help="folder of a bag or of a run")
    source.add_argument(
        "--data",
        type=a_path,
        metavar="FILE",
        help="states, actions, target and sampling time as .npz or .csv (docs/identification.md)",
    )
    add = identify.add_argument
    add(
        "--order",
        type=int,
        metavar="NS",
        help="order n_s of the model [that of the recorded run, or the suggested one]",
    )
    add(
        "--identification",
        choices=IDENTIFICATION.choices,
        help="a model of the whole field where its law is better, least squares with the inputs whole, "
        "or truncated DMDc [that of the run, or regression]",
    )
    add("--rank", type=int, metavar="P", help="p of the identification dmdc [that of the run]")
    add("--episode", metavar="N", help="only this episode, as `pdeloop bag info` names it")
    add("--environment", type=int, metavar="M", help="only this environment of each episode")
    add("--state-weight", type=float, metavar="Q", help="q of Q = q I [that of the run, or 1]")
    add("--action-weight", type=float, metavar="R", help="r of R = r I [that of the run, or 1]")
    add("--out", type=a_path, metavar="FILE", help="write A, B, U, K_a, K_b, s_r to this .npz")
    add_json(identify)


def _identify(options: argparse.Namespace) -> int:
    from pdeloop.identification import identify_bag, identify_file, save

    given = {
        "reduced_order": options.order,
        "dmdc_order": options.order,
        "identification": options.identification,
        "dmdc_rank": options.rank,
        "state_weight": options.state_weight,
        "action_weight": options.action_weight,
    }
    given = {name: value for name, value in given.items() if value is not None}
    if options.data is not None:
        if options.episode is not None or options.environment is not None:
            raise ParameterError("--episode and --environment choose from a bag; leave them out")
        found = identify_file(options.data, given)
    else:
        found = identify_bag(
            options.bag, given, episode=_episode(options.episode), environment=options.environment
        )
    if options.out is not None:
        save(found, options.out)
    for remark in found.determined.remarks:
        print(f"WARNING: {remark}", file=sys.stderr)
    if options.json:
        print_json(found.summary() | {"out": options.out and str(options.out)})
        return 0
    print(found.text())
    if options.out is not None:
        print(f"  written to {options.out}")
    return 0


def _episode(name: str | None) -> int | None:
    from loop_interfaces.episodes import episode_number

    try:
        return None if name is None else episode_number(name)
    except ValueError as error:
        raise ParameterError(
            f"--episode is {name}; expected one as `pdeloop bag info` names it, such as 1.17"
        ) from error
