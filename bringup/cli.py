"""The command line `pdeloop`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from bringup.bench.cli import add_bench
from loop_interfaces.parameters import TUNER, ParameterError, read_yaml
from loop_interfaces.problem import shipped_problems

_EXTRAS = {"rosbags": "record", "mcap": "record", "matplotlib": "report"}
"""Modules that only some commands need, and the extra that installs them."""
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
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get((error.name or "").split(".")[0])
        if extra is None:
            raise
        print(f"pdeloop: needs {error.name}: pip install 'pdeloop[{extra}]'", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("pdeloop: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        print(f"pdeloop: {error.strerror or error}{where}", file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pdeloop",
        description="Reduce, design and adapt controllers of PDEs over ROS 2 topics.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_train(commands)
    _add_evaluate(commands)
    _add_bag(commands)
    _add_identify(commands)
    _add_reproduce(commands)
    _add_report(commands)
    add_bench(commands)
    _add_secure(commands)
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
            type=lambda text: text.replace("-", "_"),  # gauss-newton as well as gauss_newton
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
        "--network",
        action="store_true",
        help="let messages leave this machine (default: loopback interface only)",
    )
    train.add_argument(
        "--faulty-line",
        metavar="LOSS,DUPLICATION,DELAY",
        help="for tests: a relay between plant and controller that loses and repeats messages with "
        "these probabilities and delays them by up to so many seconds",
    )
    train.add_argument(
        "--resume", type=Path, metavar="DIR", help="continue the interrupted run in DIR"
    )
    train.add_argument(
        "--record", action="store_true", help="record all topics to a rosbag2 bag in the folder"
    )
    train.add_argument(
        "--bag-storage", choices=("mcap", "sqlite3"), help="format of the bag [mcap]"
    )
    train.add_argument(
        "--bag-per-episode", action="store_true", help="one bag an episode instead of one"
    )
    train.add_argument(
        "--record-or-stop",
        action="store_true",
        help="as --record, and stop the training if the recording fails",
    )
    train.add_argument(
        "--directions",
        type=int,
        metavar="D",
        help="several directions an iteration, 2 D environments a seed (--optimizer directions)",
    )
    train.add_argument(
        "--pairs", type=int, default=1, metavar="K", help="plants with a controller each [1]"
    )
    train.add_argument(
        "--pin",
        action="store_true",
        help="a core for each plant and controller, and polling: less time per step, more power",
    )
    train.set_defaults(command=_train)


def _add_secure(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    secure = commands.add_parser(
        "secure",
        help="print an access policy for SROS2",
        description="Print a policy for `ros2 security generate_artifacts -p` in which each node "
        "has its own topics and nothing else (docs/security.md).",
        epilog="example: pdeloop secure --namespace /lab > policy.xml",
    )
    secure.add_argument("--namespace", default="/", metavar="NS", help="namespace of the loop [/]")
    secure.add_argument(
        "--pairs", nargs="+", default=[""], metavar="NS", help="namespaces of its pairs below it"
    )
    secure.set_defaults(command=_secure)


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


def _add_bag(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    bag = commands.add_parser(
        "bag", help="look into a recorded bag, verify it, recover it", description=_BAG
    )
    actions = bag.add_subparsers(required=True, metavar="ACTION")
    for name, command, text in (
        ("info", _bag_info, "topics and episodes of a bag"),
        ("verify", _bag_verify, "recompute states, actions, costs, models and policies"),
        ("recover", _bag_recover, "make an ordinary bag of an unfinished one"),
    ):
        action = actions.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        action.add_argument(
            "bag",
            type=Path,
            metavar="BAG",
            nargs="+" if name == "verify" else None,
            help="folder of a bag or of a run" + "; all bags of a run" * (name == "verify"),
        )
        action.set_defaults(command=command)
        if name == "info":
            action.add_argument("--json", action="store_true", help="print JSON")
        if name == "verify":
            action.add_argument(
                "--parameters", type=Path, metavar="FILE", help="instead of those in the bag"
            )
        if name == "recover":
            action.add_argument("--out", type=Path, metavar="DIR", help="[BAG-recovered]")


def _add_identify(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    identify = commands.add_parser(
        "identify",
        help="reduced model from recorded episodes",
        description="Identify a reduced model by DMDc from the exploratory episodes of a bag (all "
        "episodes if none is), of this plant or a foreign one, and design LQ-tracking gains.",
        epilog="example: pdeloop identify --bag runs/lab/bag --rank 8 --order 4 --out model.npz",
    )
    add = identify.add_argument
    add("--bag", type=Path, metavar="BAG", required=True, help="folder of a bag or of a run")
    add("--rank", type=int, metavar="P", help="p of the DMDc regression [that of the run]")
    add("--order", type=int, metavar="NS", help="order n_s of the model [that of the run]")
    add("--episode", type=int, metavar="N", help="only this episode")
    add("--environment", type=int, metavar="M", help="only this environment of each episode")
    add("--state-weight", type=float, metavar="Q", help="q of Q = q I [that of the run, or 1]")
    add("--action-weight", type=float, metavar="R", help="r of R = r I [that of the run, or 1]")
    add("--out", type=Path, metavar="FILE", help="write A, B, U, K_a, K_b, s_r to this .npz")
    identify.set_defaults(command=_identify)


def _add_reproduce(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    reproduce = commands.add_parser(
        "reproduce",
        help="the paper's experiment: four controllers, several seeds, a table",
        description="For each problem and seed: no control, LQT, LQT-PO and pure PO, with the cost "
        "of every iteration's policy on the evaluation fields. Ctrl-C interrupts; --out DIR of an "
        "interrupted reproduction continues it.",
        epilog="example: pdeloop reproduce burgers kdv --seeds 6 --out runs/paper",
    )
    add = reproduce.add_argument
    add("problems", nargs="*", metavar="PROBLEM", help="shipped names or YAML files [the paper's]")
    add("--seeds", type=int, metavar="N", help="trainings of each problem, side by side [6]")
    add("--iterations", type=int, metavar="N", help="iterations of the adapt phase [40]")
    add("--seed", type=int, metavar="S", help="the first seed [0]")
    add(
        "--identification-attempts",
        type=int,
        metavar="N",
        help="exploratory episodes a seed may use until LQT beats no control; 1: the first, "
        f"unchecked, as in the paper [{_DEFAULTS['identification_attempts'].default}]",
    )
    add("--processes", type=int, metavar="N", help="jobs at the same time [one a core]")
    add("--out", type=Path, metavar="DIR", help="folder of the results [runs/reproduce-TIME]")
    reproduce.set_defaults(command=_reproduce)


def _add_report(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    report = commands.add_parser(
        "report",
        help="figures and an HTML page of a run or a reproduction",
        description="Figures for a paper (PNG and SVG) and one HTML page that needs no network.",
        epilog="example: pdeloop report runs/paper",
    )
    report.add_argument(
        "folder", type=Path, metavar="DIR", help="folder of a finished run or reproduction"
    )
    report.add_argument("--out", type=Path, metavar="DIR", help="[DIR/report]")
    report.set_defaults(command=_report)


_BAG = "Look into a bag that --record or recorder_node wrote, verify it, or recover it."


def _train(options: argparse.Namespace) -> int:
    from bringup.training_run import Recording, Transport, run_again, run_new

    recording = None
    if options.record or options.record_or_stop:
        import recorder_node.bag  # noqa: F401  # the recorder would only say so in its log

        storage = options.bag_storage or "mcap"
        recording = Recording(storage, options.bag_per_episode, options.record_or_stop)
    elif options.bag_storage or options.bag_per_episode:
        raise ParameterError("--bag-storage and --bag-per-episode go with --record")
    transport = Transport(
        options.in_process,
        recording,
        options.network,
        options.faulty_line,
        options.pairs,
        options.pin,
    )
    names = ("iterations", "seed", "seeds", "start", "optimizer", "directions")
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    if (
        options.directions is not None
        and given.setdefault("optimizer", "directions") != "directions"
    ):
        raise ParameterError("--directions goes with --optimizer directions")
    if options.resume is not None:
        if options.problem or given or options.out:
            raise ParameterError(
                "--resume continues a run with its own parameters; "
                "give it alone (or with --in-process)"
            )
        return run_again(options.resume, transport)
    if options.problem is None:
        raise ParameterError(
            f"no problem given; expected one of {', '.join(shipped_problems())}, a YAML file, "
            "or --resume DIR"
        )
    return run_new(options.problem, given, options.out, transport)


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


def _bag_info(options: argparse.Namespace) -> int:
    from bringup.bags.tools import describe, info_text

    content = describe(options.bag)
    print(json.dumps(content) if options.json else info_text(content))
    return 0


def _bag_verify(options: argparse.Namespace) -> int:
    from bringup.bags.verify import verify

    report = verify(*options.bag, parameters=options.parameters)
    print(report.text())
    return 1 if report.count else 0


def _bag_recover(options: argparse.Namespace) -> int:
    from bringup.bags.tools import recover

    path, messages = recover(options.bag, options.out)
    print(f"{messages} messages in {path}")
    return 0


def _identify(options: argparse.Namespace) -> int:
    from bringup.bags.identification import identify, save

    found = identify(
        options.bag,
        rank=options.rank,
        order=options.order,
        episode=options.episode,
        environment=options.environment,
        weights=(options.state_weight, options.action_weight),
    )
    print(found.text())
    if options.out is not None:
        save(found, options.out)
        print(f"  written to {options.out}")
    return 0


def _reproduce(options: argparse.Namespace) -> int:
    from bringup.reproduce.experiment import reproduce

    names = ("seeds", "iterations", "seed", "identification_attempts")
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    for name, value in given.items():
        _DEFAULTS[name].check(value)
    return reproduce(options.problems, given, options.out, options.processes)


def _report(options: argparse.Namespace) -> int:
    from bringup.report.page import report

    page = report(options.folder, options.out)
    print(f"report in {page}")
    return 0


def _secure(options: argparse.Namespace) -> int:
    from bringup.secure import policy

    print(policy(options.namespace, tuple(options.pairs)), end="")
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
