# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop identify`."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from math import inf, isfinite, nan

from pdeloop.commands import common
from pdeloop.messages.parameters import IDENTIFICATION
from pdeloop.messages.spec import ParameterError
from pdeloop.output import print_json

OF_DATA = (
    *("time", "states", "inputs", "sample_time"),
    *("time_unit", "missing", "cut", "resample", "input_delay", "validate"),
)
"""The options that only --data has."""
MOST_DELAYED = 100
"""Rows by which inputs may be shifted."""


def add(commands: common.Commands) -> None:
    """The command `identify`."""
    identify = common.command(
        commands,
        "identify",
        _identify,
        help="identify a reduced model from recorded episodes or your own measurements",
        description="Identify a reduced model by least squares in reduced coordinates, design "
        "LQ-tracking gains, and show which order the data support: singular values, and errors on "
        "held-out steps. The data are the exploratory episodes of a bag of any plant (all episodes "
        "if none explores), or measurements in a file.",
        example="pdeloop identify --data examples/measurements.csv --out model.npz",
    )
    source = identify.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--bag", type=common.a_path, metavar="BAG", help="folder of a bag or of a run"
    )
    source.add_argument(
        "--data",
        type=common.a_path,
        metavar="FILE",
        nargs="+",
        help="states, actions, target and sampling time as .npz, .csv, .mat or .parquet, one file or "
        "several of one plant (docs/identification.md)",
    )
    add = identify.add_argument_group("with --data").add_argument
    add("--time", metavar="NAME", help="the column of times (s), or the array sample_time [t]")
    add(
        "--states",
        metavar="NAME,...",
        help="the columns of the state: names or patterns like 'T*'; other columns are ignored "
        "[those whose names begin with z]",
    )
    add(
        "--inputs",
        metavar="NAME,...",
        help="the columns of the inputs [those whose names begin with a]",
    )
    add("--sample-time", type=float, metavar="S", help="sampling time (s), if no column has times")
    add(
        "--time-unit", metavar="UNIT", help="unit of the times [the one in the column's name, or s]"
    )
    add(
        "--missing",
        type=partial(_numbers, finite=False),
        metavar="X,...",
        help="values that stand for missing readings, as in --missing=-9999",
    )
    add(
        "--cut",
        action="store_true",
        default=None,
        help="leave out rows with missing readings, spikes, frozen or saturated sensors, and begin a "
        "new trajectory there and after gaps",
    )
    add(
        "--resample",
        type=_step,
        nargs="?",
        const=0.0,
        metavar="S",
        help="interpolate to equal steps of S seconds [without S, the log's own]",
    )
    add(
        "--input-delay",
        type=_delays,
        metavar="N,...",
        help="rows by which the inputs act later than their own, all or each: a dead time above 0, a "
        "log whose inputs are late below; auto: what fits held-out data best [0]",
    )
    add(
        "--validate",
        type=common.a_path,
        metavar="FILE",
        nargs="+",
        help="other logs of the plant, in the same form: the FIT of the model's simulation of each",
    )
    add = identify.add_argument
    add(
        "--target",
        type=_numbers,
        metavar="X,X,...",
        help="the target state, one number per entry [the data's; without a target, only a model "
        "is identified]",
    )
    add(
        "--order",
        type=int,
        metavar="NS",
        help="order n_s of the model [the recorded run's, or the suggested one]",
    )
    add(
        "--identification",
        choices=IDENTIFICATION.choices,
        help="field: a model of the whole field where its law is better; regression: least squares "
        "in reduced coordinates; subspace: a model with its filter, from measurements alone; dmdc: "
        "truncated DMDc [the run's, or field]",
    )
    common.add_own_code(identify, ("law",))
    add("--rank", type=int, metavar="P", help="rank p of --identification dmdc [the run's]")
    add("--episode", metavar="N", help="use only this episode, as `pdeloop bag info` names it")
    add("--environment", type=int, metavar="M", help="use only this environment of each episode")
    add("--state-weight", type=float, metavar="Q", help="q of Q = q I [the run's, or 1]")
    add("--action-weight", type=float, metavar="R", help="r of R = r I [the run's, or 1]")
    add(
        "--out",
        type=common.a_path,
        metavar="FILE",
        help="write A, B, U, K_a, K_b, s_r to this .npz",
    )
    add(
        "--plot",
        type=common.a_path,
        metavar="FILE",
        help="draw the orders, the model against the data, and the law on the model to this .png, .svg "
        "or .pdf",
    )
    common.add_json(identify)


def _identify(options: argparse.Namespace) -> int:
    from pdeloop.data_file import read_measurements
    from pdeloop.identification import identify_bag, identify_data, save

    given = {
        "reduced_order": options.order,
        "dmdc_order": options.order,
        "identification": options.identification,
        "dmdc_rank": options.rank,
        "state_weight": options.state_weight,
        "action_weight": options.action_weight,
    }
    given = {name: value for name, value in given.items() if value is not None}
    given |= common.allow_own_code(options)
    if options.data is not None:
        if options.episode is not None or options.environment is not None:
            raise ParameterError("--episode and --environment choose from a bag; leave them out")
        table = {name: getattr(options, name) or "" for name in ("time", "states", "inputs")}
        read = partial(
            read_measurements,
            **table,
            sample_time=options.sample_time,
            target=options.target,
            time_unit=options.time_unit or "",
            missing=options.missing,
            cut=bool(options.cut),
            resample=options.resample,
        )
        delay, others = options.input_delay, {}
        for path in options.validate or ():
            read(options.data[0], path)  # of one plant
            others[str(path)] = read(path)
        found = identify_data(
            read(*options.data), given, None if delay == "auto" else delay or (), others
        )
    else:
        for name in OF_DATA:
            if getattr(options, name) is not None:
                flag = f"--{name.replace('_', '-')}"
                raise ParameterError(
                    f"{flag} applies to --data only; a bag has names and times: leave it out"
                )
        found = identify_bag(
            options.bag,
            given,
            episode=_episode(options.episode),
            environment=options.environment,
            target=options.target,
        )
    if options.out is not None:
        save(found, options.out)
    if options.plot is not None:
        from pdeloop.identification_plot import draw

        draw(found, options.plot)
    for remark in found.warnings:
        print(f"WARNING: {remark}", file=sys.stderr)
    if options.json:
        files = {"out": options.out, "plot": options.plot}
        print_json(found.summary() | {name: path and str(path) for name, path in files.items()})
        return 0
    print(found.text())
    if options.out is not None:
        print(f"written to {options.out}")
    if options.plot is not None:
        print(f"picture in {options.plot}")
    return 0


def _numbers(text: str, finite: bool = True) -> list[float]:
    """A list of numbers, for argparse."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or (finite and not all(map(isfinite, numbers))):
        raise argparse.ArgumentTypeError(
            f"expected {'finite ' * finite}numbers with commas between, got '{text}'"
        )
    return numbers


def _step(text: str) -> float:
    """Seconds above 0, for argparse; 0 is the option without a number."""
    try:
        step = float(text)
    except ValueError:
        step = nan
    if not 0.0 < step < inf:
        raise argparse.ArgumentTypeError(
            f"expected seconds above 0, got '{text}'; without a number it is the log's own step"
        )
    return step


def _delays(text: str) -> tuple[int, ...] | str:
    """auto, or whole numbers with commas between, for argparse."""
    if text == "auto":
        return text
    try:
        found = tuple(int(part) for part in text.split(","))
    except ValueError:
        found = ()
    if not found or max(map(abs, found)) > MOST_DELAYED:
        raise argparse.ArgumentTypeError(
            f"expected auto, or whole numbers up to {MOST_DELAYED} with commas between, got '{text}'"
        )
    return found


def _episode(name: str | None) -> int | None:
    from pdeloop.messages.topics import episode_number

    try:
        return None if name is None else episode_number(name)
    except ValueError as error:
        raise ParameterError(
            f"--episode is {name}; expected one as `pdeloop bag info` names it, such as 1.17"
        ) from error
