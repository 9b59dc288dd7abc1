"""`python -m benchmarks PROGRAM`: the measuring programs. Each is imported when it is called."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from pathlib import Path
from typing import Any

from pdeloop.cli import run
from pdeloop.commands.common import Commands, add_json, command
from pdeloop.output import print_json


def parser() -> argparse.ArgumentParser:
    """The parser of all programs."""
    root = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure. What is compared runs in turns in one run; figures are medians.",
        epilog="example: python -m benchmarks rtt --turns 3",
    )
    programs = root.add_subparsers(required=True, metavar="PROGRAM")
    rtt = _add(
        programs,
        "rtt",
        "rounds a second of the loop beside a bare ping-pong",
        "--turns 3 --seconds 0.3",
    )
    rtt.add_argument("--turns", type=int, default=9, metavar="N", help="turns of each [9]")
    rtt.add_argument("--seconds", type=float, default=0.4, metavar="S", help="of a turn [0.4]")
    rtt.add_argument(
        "--only",
        choices=("any", "shared", "pinned"),
        help="plant and controller on any cores, on one for both, or on one each; one of the three",
    )
    batch = _add(
        programs, "batch", "environment-steps a second against the batch", "--problem kdv --turns 5"
    )
    batch.add_argument("--problem", default="allen-cahn", metavar="PROBLEM", help="[allen-cahn]")
    batch.add_argument("--turns", type=int, default=3, metavar="N", help="turns of each [3]")
    train = _add(
        programs,
        "train",
        "a whole training: topics against in-process",
        "--problem burgers --turns 2 --out train.json",
    )
    train.add_argument("--problem", default="burgers", metavar="PROBLEM", help="[burgers]")
    train.add_argument("--turns", type=int, default=3, metavar="N", help="trainings of each [3]")
    train.add_argument("--iterations", type=int, default=40, metavar="N", help="[40]")
    train.add_argument("--pin", action="store_true", help="with --pin as well")
    real = _add(
        programs,
        "realtime",
        "jitter and missed deadlines at P1's 20 Hz and at 1 kHz",
        "--seconds 30 --pin",
    )
    real.add_argument("--seconds", type=float, default=10.0, metavar="S", help="of each rate [10]")
    real.add_argument("--pin", action="store_true", help="both kept on one core")
    pairs = _add(
        programs,
        "pairs",
        "1, 2, 4 pairs on hosts made of network namespaces (needs root)",
        "--pairs 1 2 --loss 0.05",
    )
    pairs.add_argument(
        "--pairs", type=int, nargs="+", default=[1, 2, 4], metavar="K", help="[1 2 4]"
    )
    pairs.add_argument("--iterations", type=int, default=20, metavar="N", help="[20]")
    pairs.add_argument("--loss", type=float, default=0.01, help="share of lost messages [0.01]")
    pairs.add_argument("--delay", type=float, default=0.002, help="largest delay in s [0.002]")
    pairs.add_argument("--problem", default="burgers", metavar="PROBLEM", help="[burgers]")
    _add_baselines(programs)
    _add_reinforcement(programs)
    optimum = _add(
        programs,
        "optimum",
        "what the policy class and any controller at all could reach, by exact gradients",
        "burgers --seeds 1 --fields 4",
    )
    add = optimum.add_argument
    add("problems", nargs="*", metavar="PROBLEM", help="shipped names or YAML files [the paper's]")
    add("--seeds", type=int, metavar="N", help="trainings whose basis U is used [6]")
    add("--first-seed", type=int, metavar="S", help="the first of them [0]")
    add("--fields", type=int, metavar="M", help="initial fields a law is optimised on [16]")
    add(
        "--evaluation-seed",
        type=int,
        nargs="+",
        metavar="S",
        help="draws of held-out fields to measure on [0, that of a training's evaluation]",
    )
    add("--evaluation-fields", type=int, metavar="N", help="fields of each draw [10]")
    add(
        "--tolerance",
        type=float,
        metavar="SHARE",
        help="converged when 20 iterations lower the cost by less [2e-4]",
    )
    add("--iterations", type=int, metavar="N", help="of L-BFGS, at most [1000]")
    add("--jobs", type=int, metavar="N", help="processes [one a core]")
    add(
        "--no-checks",
        dest="checks",
        action="store_false",
        help="leave out what the first seed gives from zero and with twice the fields",
    )
    add("--save", type=Path, metavar="DIR", help="write DIR/PROBLEM.json, which reports read")
    monitor = _add(
        programs,
        "monitor",
        "how much pdeloop monitor with an open page slows the loop",
        "--windows 8",
    )
    monitor.add_argument("--problem", default="allen-cahn", metavar="PROBLEM", help="[allen-cahn]")
    monitor.add_argument("--windows", type=int, default=8, metavar="N", help="of each [8]")
    monitor.add_argument("--seconds", type=float, default=4.0, metavar="S", help="of a window [4]")
    monitor.add_argument(
        "--browser", action="store_true", help="with the page drawn by a headless chromium"
    )
    linearised = _add(
        programs,
        "linearised",
        "what the LQR law of the exact linearisation about 0 costs",
        "wave cahn-hilliard",
    )
    linearised.add_argument("problems", nargs="+", metavar="PROBLEM", help="names or YAML files")
    linearised.add_argument("--n-a", type=int, metavar="N", help="actuators [the problem's]")
    linearised.add_argument("--width", type=float, metavar="X", help="of one, as a share of L")
    environments = _add(
        programs,
        "environments",
        "steps a second of the Gymnasium environments",
        "--problem kdv --num-envs 4 16",
    )
    environments.add_argument("--problem", metavar="PROBLEM", help="[burgers]")
    environments.add_argument("--num-envs", type=int, nargs="+", metavar="M", help="[1 4 16]")
    environments.add_argument("--turns", type=int, metavar="N", help="turns of each [3]")
    environments.add_argument(
        "--controlgym", metavar="PYTHON", help="interpreter with controlgym 1.0.0"
    )
    workers = _add(
        programs,
        "workers",
        "wall time of a study against the number of its worker processes",
        "--seeds 8 --workers 1 2 4",
    )
    workers.add_argument("--problem", metavar="PROBLEM", help="[burgers]")
    workers.add_argument("--seeds", type=int, metavar="N", help="trainings [8]")
    workers.add_argument("--rollouts", type=int, metavar="N", help="of a training [20]")
    workers.add_argument("--workers", type=int, nargs="+", metavar="N", help="[1 2]")
    participants = _add(
        programs,
        "participants",
        "memory and processor time of many idle nodes that know each other",
        "--pairs 10 60",
    )
    participants.add_argument(
        "--pairs", type=int, nargs="+", metavar="K", help="of plant and controller [1 15 30 60]"
    )
    participants.add_argument("--seconds", type=float, metavar="S", help="of a measurement [20]")
    services = _add(
        programs,
        "services",
        "how soon a recorded training answers its operator, and Ctrl-C",
        "--calls 50",
    )
    services.add_argument("--problem", metavar="PROBLEM", help="[burgers]")
    services.add_argument("--calls", type=int, metavar="N", help="of each service [20]")
    services.add_argument("--queued", type=int, metavar="N", help="requests at once [20]")
    kernel = _add(
        programs, "kernel", "time of a step beside other implementations", "--batches 1 12 --json"
    )
    kernel.add_argument(
        "--batches", type=int, nargs="+", default=[1, 2, 12, 64], metavar="M", help="[1 2 12 64]"
    )
    kernel.add_argument("--jax", metavar="PYTHON", help="interpreter that can import JAX")
    kernel.add_argument("--controlgym", metavar="PYTHON", help="interpreter with controlgym 1.0.0")
    return root


def _add_baselines(programs: Commands) -> None:
    """The comparison of methods; its defaults are those of the program."""
    add = _add(
        programs,
        "baselines",
        "optimisers and methods of others at equal rollouts, with intervals over seeds",
        "kdv --rollouts 20 --seeds 2",
    ).add_argument
    add("problem", metavar="PROBLEM", help="one of benchmarks/studies, or a YAML file like those")
    add("--rollouts", type=int, nargs="+", metavar="N", help="budgets, in all [20 40 80]")
    add("--seeds", type=int, metavar="N", help="number of seeds [the study's]")
    add("--methods", nargs="+", metavar="NAME", help="only these [all of the file]")
    add(
        "--set",
        nargs="+",
        metavar="NAME=JSON",
        dest="settings",
        help="parameters of the problem for all methods, like sensors=16",
    )
    add(
        "--tune",
        nargs="+",
        metavar="NAME=JSON",
        help="compare values of constants or parameters on the validation split, like sigma=[0.1,0.3]",
    )
    add("--folder", type=Path, metavar="DIR", help="of the runs [runs/baselines-PROBLEM]")
    add("--processes", type=int, metavar="N", help="trainings at the same time [one a core]")
    add(
        "--any-environment",
        action="store_true",
        help="go on with results of other versions or another processor, as pdeloop study does",
    )
    add("--figure", type=Path, metavar="FILE", help="draw the costs against the rollouts")


def _add_reinforcement(programs: Commands) -> None:
    """Reinforcement learning, which needs a virtual environment of its own."""
    add = _add(
        programs,
        "reinforcement",
        "learning curve of PPO or SAC of stable-baselines3 (docs/optimizers.md says how to install it)",
        "burgers --algorithm ppo --minutes 2",
    ).add_argument
    add("problem", metavar="PROBLEM", help="a shipped problem or a YAML file")
    add("--algorithm", choices=("ppo", "sac"), help="[ppo]")
    add("--seed", type=int, metavar="S", help="[0]")
    add("--minutes", type=float, metavar="N", help="of processor time at most [20]")
    add(
        "--reach",
        type=float,
        metavar="X",
        help="bound of the actions over LQ tracking's largest [1]",
    )
    add("--environments", type=int, metavar="M", help="advanced in a batch [4]")
    add("--folder", type=Path, metavar="DIR", help="that of baselines, for a row at 80 rollouts")


def _add(programs: Commands, name: str, text: str, example: str) -> argparse.ArgumentParser:
    program = command(
        programs, name, _bench, help=text, example=f"python -m benchmarks {name} {example}"
    )
    add_json(program, "print JSON instead of a table")
    program.add_argument("--out", type=Path, metavar="FILE", help="write the JSON there, too")
    program.set_defaults(program=name)
    return program


def _bench(options: argparse.Namespace) -> int:
    given = {
        name: value
        for name, value in vars(options).items()
        if name not in ("command", "refuse", "program", "json", "out") and value is not None
    }
    result, text = _measure(options.program, given)
    if options.out is not None:
        options.out.write_text(json.dumps(result, indent=1) + "\n")
    if options.json:
        print_json(result)
    else:
        print(text)
    return 0


def _measure(program: str, given: dict[str, Any]) -> tuple[Any, str]:
    module = importlib.import_module(f"benchmarks.{program}")
    if program == "kernel":
        from dataclasses import asdict

        for name in ("jax", "controlgym"):
            given[f"{name}_python"] = given.pop(name, None)
        rows = module.run(**given)
        return [asdict(row) for row in rows], module.table(rows)
    if program == "rtt":
        only = given.pop("only", None)
        if only:
            given["cores"] = (only,)
    result = module.run(**given)
    return result, module.text(result)


if __name__ == "__main__":
    sys.exit(run(parser))
