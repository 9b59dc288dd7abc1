# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop train`."""

from __future__ import annotations

import argparse

from pdeloop.commands import common
from pdeloop.commands.settings import add_set, joined, read_settings
from pdeloop.messages.problem import shipped_problems
from pdeloop.messages.spec import ParameterError
from pdeloop.process.quick_imports import quick_imports


def add(commands: common.Commands) -> None:
    """The command `train`."""
    train = common.command(
        commands,
        "train",
        _train,
        help="train a controller: identify, design, adapt, evaluate",
        description="Train a controller: identify a reduced model, design LQ-tracking gains, adapt "
        "them from rollouts, and evaluate them. The plant, the controller and the tuner run as ROS 2 "
        "nodes in separate processes. Plants that you have: --plant rod.fmu --set fmu.inputs=q1,q2, or "
        "--plant 'process:python rod.py'.",
        example="pdeloop train burgers --rollouts 80 --seed 0",
    )
    problem = train.add_argument_group("problem")
    names = ", ".join(shipped_problems())
    common.add_problem(problem, f"{names}, or the path of a problem's YAML file")
    common.add_own_code(problem, ("equation", "plant"))
    common.add_flags(problem, "problem")
    method = train.add_argument_group("budget and method")
    common.add_flags(method, "budget and method")
    add = method.add_argument
    add(
        "--model",
        type=common.a_path,
        metavar="FILE",
        help="start from this model instead of identifying one: of `pdeloop identify --out`, or an "
        ".npz with the arrays A and B, and U, d and C where it has them",
    )
    add_set(method)
    run = train.add_argument_group("run")
    add = run.add_argument
    add(
        "--out", type=common.a_path, metavar="DIR", help="folder of the results [runs/PROBLEM-TIME]"
    )
    add("--resume", type=common.a_path, metavar="DIR", help="continue the interrupted run in DIR")
    add(
        "--in-process",
        action="store_true",
        help="run the same code without ROS; the policy is the same to the bit",
    )
    common.add_json(run, "print the result as JSON at the end; progress goes to stderr")
    add = train.add_argument_group("recording").add_argument
    add("--record", action="store_true", help="record all topics to a rosbag2 bag in the folder")
    add(
        "--record-or-stop",
        action="store_true",
        help="like --record, but stop the training if the recording fails",
    )
    add(
        "--record-every",
        type=int,
        default=1,
        metavar="N",
        help="record only the states of every N-th step, for large fields [1]",
    )
    add(
        "--view",
        action="store_true",
        help="also start a viewer_node, for RViz, Foxglove and PlotJuggler (docs/watching.md)",
    )
    add = train.add_argument_group("machine").add_argument
    add(
        "--network",
        action="store_true",
        help="let messages leave this machine (default: loopback interface only)",
    )
    add(
        "--pairs",
        type=int,
        default=1,
        metavar="K",
        help="number of plants, each with a controller [1]",
    )


def _train(options: argparse.Namespace) -> int:
    with quick_imports():
        from pdeloop.pairs import Transport
        from pdeloop.training_run import begin, reopen, resolve, run

    recorded = options.record or options.record_or_stop
    if recorded:
        import recorder_node.bag  # noqa: F401  # the recorder would only say so in its log
    transport = Transport(
        options.in_process,
        recorder="required" if options.record_or_stop else "start" if recorded else "none",
        record_every=options.record_every,
        network=options.network,
        pairs=options.pairs,
        view=options.view,
    )
    transport.require()
    settings = read_settings(options.set)
    given = joined(common.given_flags(options), settings)
    for name in ("rollouts", "iterations"):
        if given.get(name) == 0:
            raise ParameterError(f"--{name} is 0; expected a whole number of at least 1")
    own = common.allow_own_code(options)
    if options.model is not None:
        given["model"] = str(options.model.resolve())
    if options.resume is not None:
        common.forget_named_anew(given, own)
        if options.problem or given or options.out:
            raise ParameterError(
                "--resume continues a run with its own parameters; "
                "give it alone (or with --in-process)"
            )
        values = reopen(options.resume)
        common.refuse_other_code(options, values)
        return run(options.resume, values, transport, options.json)
    if options.problem is None and options.plant is None:
        raise ParameterError(
            f"no problem given; expected one of {', '.join(shipped_problems())}, a YAML file, "
            "--plant NAME, or --resume DIR"
        )
    given |= own
    problem = options.problem or ""
    if options.sensor_delays is not None and not resolve(problem, given)["sensors"]:
        raise ParameterError("--sensor-delays needs --sensors N, or a problem with sensors")
    folder, values = begin(problem, given, options.out, transport)
    return run(folder, values, transport, options.json)
