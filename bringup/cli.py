"""The command line `pdeloop`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from loop_interfaces.parameters import TUNER, ParameterError, read_yaml
from loop_interfaces.problem import shipped_problems

_DEFAULTS = {spec.name: spec for spec in TUNER}


def main(arguments: Sequence[str] | None = None) -> int:
    """Console script. Every error a user can cause is one line on stderr and exit code 1 or 2."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        code: int = options.command(options)
        return code
    except (ValueError, RuntimeError) as error:
        # RunFolderError, CheckpointError, ParameterError, DomainError, NodeError and the plant's
        # and controller's refusals; anything else is a bug and shows its traceback.
        print(f"pdeloop: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        sys.stderr.close()
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pdeloop",
        description="Reduce, design and adapt controllers of PDEs over ROS 2 topics.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_train(commands)
    _add_evaluate(commands)
    problems = commands.add_parser(
        "problems",
        help="list the shipped problems",
        description="List the shipped problems.",
    )
    problems.set_defaults(command=_problems)
    return parser


def _add_train(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    train = commands.add_parser(
        "train",
        help="identify, design, adapt and evaluate",
        description="Train a controller: identify a reduced model, design LQ-tracking gains, adapt "
        "them by policy gradient, evaluate. The plant, the controller and the tuner run as ROS 2 "
        "nodes in processes of their own.",
        epilog="example: pdeloop train burgers --iterations 40 --seed 0",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    train.add_argument(
        "problem",
        nargs="?",
        metavar="PROBLEM",
        help=f"{', '.join(shipped_problems())}, or the path of a problem's YAML file",
    )
    for name, metavar in (("iterations", "N"), ("seed", "S"), ("seeds", "N")):
        spec = _DEFAULTS[name]
        train.add_argument(
            f"--{name}", type=int, metavar=metavar, help=f"{spec.description} [{spec.default}]"
        )
    for name in ("start", "optimizer"):
        spec = _DEFAULTS[name]
        train.add_argument(
            f"--{name}",
            choices=spec.choices,
            help=f"{spec.description} [{spec.default}]",
        )
    train.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the results [runs/PROBLEM-TIME]"
    )
    train.add_argument(
        "--in-process",
        action="store_true",
        help="run the same code without ROS; the policy is the same to the bit",
    )
    train.add_argument(
        "--resume", type=Path, metavar="DIR", help="continue the interrupted run in DIR"
    )
    train.set_defaults(command=_train)


def _add_evaluate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    evaluate = commands.add_parser(
        "evaluate",
        help="cost of a run's policies on other fields",
        description="Roll out no control, LQT and the adapted policy of a finished run.",
        epilog="example: pdeloop evaluate runs/burgers-20260101-120000-1 --fields 60 --seed 7",
    )
    evaluate.add_argument("folder", type=Path, metavar="DIR", help="folder of a finished run")
    evaluate.add_argument(
        "--fields", type=int, default=10, metavar="N", help="sampled initial fields [10]"
    )
    evaluate.add_argument(
        "--seed", type=int, default=0, metavar="S", help="seed of those fields [0]"
    )
    evaluate.add_argument(
        "--mean-field",
        action="store_true",
        help="the mean of the initial distribution instead of sampled fields",
    )
    evaluate.add_argument("--json", action="store_true", help="print JSON")
    evaluate.set_defaults(command=_evaluate)


def _train(options: argparse.Namespace) -> int:
    from bringup.training_run import run_again, run_new

    names = ("iterations", "seed", "seeds", "start", "optimizer")
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    if options.resume is not None:
        if options.problem or given or options.out:
            raise ParameterError(
                "--resume continues a run with its own parameters; "
                "give it alone (or with --in-process)"
            )
        return run_again(options.resume, options.in_process)
    if options.problem is None:
        raise ParameterError(
            f"no problem given; expected one of {', '.join(shipped_problems())}, a YAML file, "
            "or --resume DIR"
        )
    return run_new(options.problem, given, options.out, options.in_process)


def _evaluate(options: argparse.Namespace) -> int:
    from bringup.evaluation import as_text, evaluate

    spec = _DEFAULTS["evaluation_fields"]
    spec.check(options.fields)
    _DEFAULTS["evaluation_seed"].check(options.seed)
    costs = evaluate(
        options.folder, fields=options.fields, seed=options.seed, mean_field=options.mean_field
    )
    print(json.dumps(costs) if options.json else as_text(costs))
    return 0


def _problems(options: argparse.Namespace) -> int:
    for name, path in shipped_problems().items():
        values = read_yaml(path)
        first = path.read_text().splitlines()[0].removeprefix("# ").split("   ")[0]
        print(
            f"{name:<12} {first}\n{'':<12} {values['n_z']} points, {values['n_a']} actuators, "
            f"{values['horizon']} steps of {values['sample_time']:g} s; {path}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
