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
    """The parser of all programs; an option that is not given has the default of the program."""
    root = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure. What is compared runs in turns in one run; figures are medians.",
        epilog="example: python -m benchmarks rtt --turns 3",
    )
    programs = root.add_subparsers(required=True, metavar="PROGRAM")
    rtt = Program(programs, "rtt", "rounds a second of the loop beside a bare ping-pong")
    rtt.add("--turns", "N", "turns of each [7]", type=int)
    rtt.add("--seconds", "S", "of a turn [0.4]", type=float)
    rtt.add(
        "--cores",
        "WHERE",
        "plant and controller on any cores, on one for both (shared), on one each (pinned) [all]",
        choices=("any", "shared", "pinned"),
        nargs="+",
    )
    batch = Program(programs, "batch", "environment-steps a second against the batch")
    batch.add("--problem", "PROBLEM", "[allen-cahn]")
    batch.add("--turns", "N", "turns of each [3]", type=int)
    train = Program(programs, "train", "a whole training: topics against in-process")
    train.add("--problem", "PROBLEM", "[burgers]")
    train.add("--turns", "N", "trainings of each [3]", type=int)
    train.add("--iterations", "N", "[40]", type=int)
    real = Program(
        programs, "realtime", "jitter and missed deadlines at P1's 20 Hz and at 1 kHz", "--pin"
    )
    real.add("--seconds", "S", "of each rate [10]", type=float)
    real.switch("--pin", "both kept on one core")
    pairs = Program(
        programs, "pairs", "1, 2, 4 pairs on hosts made of network namespaces (needs root)"
    )
    pairs.add("--pairs", "K", "[1 2 4]", type=int, nargs="+")
    pairs.add("--iterations", "N", "[20]", type=int)
    _add_baselines(programs)
    _add_reinforcement(programs)
    _add_optimum(programs)
    overhead = Program(
        programs,
        "overhead",
        "how much a recorder, a viewer or an open page of pdeloop monitor slows the loop",
        "monitor --windows 8",
    )
    overhead.add("what", None, "comes and goes", choices=("recorder", "viewer", "monitor"))
    overhead.add("--problem", "PROBLEM", "[burgers]")
    overhead.add("--windows", "N", "with it and without it [6]", type=int)
    overhead.add("--seconds", "S", "of a window [3]", type=float)
    linearised = Program(
        programs,
        "linearised",
        "what the LQR law of the exact linearisation at the target costs",
        "wave cahn-hilliard",
    )
    linearised.add("problems", "PROBLEM", "names or YAML files", nargs="+")
    environments = Program(
        programs, "environments", "steps a second of the Gymnasium environments", "--problem kdv"
    )
    environments.add("--problem", "PROBLEM", "[burgers]")
    environments.add("--num-envs", "M", "[1 4 16]", type=int, nargs="+")
    environments.add("--turns", "N", "turns of each [3]", type=int)
    environments.add("--controlgym", "PYTHON", "interpreter with controlgym 1.0.0")
    workers = Program(
        programs, "workers", "wall time of a study against the number of its worker processes"
    )
    workers.add("--problem", "PROBLEM", "[burgers]")
    workers.add("--seeds", "N", "trainings [8]", type=int)
    workers.add("--workers", "N", "[1 2]", type=int, nargs="+")
    participants = Program(
        programs,
        "participants",
        "memory and processor time of many idle nodes that know each other",
        "--pairs 10 60",
    )
    participants.add("--pairs", "K", "of plant and controller [1 15 30 60]", type=int, nargs="+")
    participants.add("--seconds", "S", "of a measurement [20]", type=float)
    services = Program(
        programs, "services", "how soon a recorded training answers its operator, and Ctrl-C"
    )
    services.add("--problem", "PROBLEM", "[burgers]")
    services.add("--calls", "N", "of each service [20]", type=int)
    services.add("--queued", "N", "requests at once [20]", type=int)
    kernel = Program(
        programs, "kernel", "time of a step beside other implementations", "--batches 1 12"
    )
    kernel.add("--batches", "M", "[1 2 12 64]", type=int, nargs="+")
    kernel.add("--jax", "PYTHON", "interpreter that can import JAX")
    return root


def _add_baselines(programs: Commands) -> None:
    program = Program(
        programs,
        "baselines",
        "optimisers and methods of others at equal rollouts, with intervals over seeds",
        "kdv --rollouts 20 --seeds 2",
    )
    program.add("studies", "STUDY", "of benchmarks/studies, or YAML files like those", nargs="+")
    program.add("--rollouts", "N", "budgets, in all [20 40 80]", type=int, nargs="+")
    program.add("--seeds", "N", "number of seeds [the study's]", type=int)
    program.add("--methods", "NAME", "only these [all of the file]", nargs="+")
    program.add(
        "--settings",
        "NAME=JSON",
        "parameters of the problem for all methods, like sensors=16",
        nargs="+",
    )
    program.add(
        "--tune",
        "NAME=JSON",
        "compare values of constants or parameters on the validation split, like sigma=[0.1,0.3]",
        nargs="+",
    )
    program.add("--folder", "DIR", "of the runs [runs/baselines]", type=Path)
    program.add("--processes", "N", "trainings at the same time [one a core]", type=int)
    program.switch(
        "--any-environment",
        "go on with results of other versions or another processor, as pdeloop study does",
    )
    program.add("--figure", "FILE", "draw the costs against the rollouts", type=Path)


def _add_reinforcement(programs: Commands) -> None:
    program = Program(
        programs,
        "reinforcement",
        "learning curve of PPO or SAC of stable-baselines3 (docs/optimizers.md says how to install it)",
        "burgers --algorithm ppo --minutes 2",
    )
    program.add("problem", "PROBLEM", "a shipped problem or a YAML file")
    program.add("--algorithm", None, "[ppo]", choices=("ppo", "sac"))
    program.add("--seed", "S", "[0]", type=int)
    program.add("--minutes", "N", "of processor time at most [20]", type=float)
    program.add("--rollouts", "N", "at most [40960]", type=int)
    program.add("--settings", "NAME=JSON", "constants, like gamma=0.98", nargs="+")
    program.add("--folder", "DIR", "that of baselines, for rows at its budgets", type=Path)


def _add_optimum(programs: Commands) -> None:
    program = Program(
        programs,
        "optimum",
        "what the policy class and any controller at all could reach, by exact gradients",
        "burgers --seeds 1 --fields 4",
    )
    program.add("problems", "PROBLEM", "shipped names or YAML files [the paper's]", nargs="*")
    program.add("--seeds", "N", "trainings whose basis U is used [6]", type=int)
    program.add("--fields", "M", "initial fields a law is optimised on [16]", type=int)
    program.add(
        "--evaluation-seed", "S", "draws of held-out fields to measure on [0]", type=int, nargs="+"
    )
    program.add("--evaluation-fields", "N", "fields of each draw [10]", type=int)
    program.add("--tolerance", "SHARE", "converged when 20 iterations gain less [2e-4]", type=float)
    program.add("--jobs", "N", "processes [one a core]", type=int)
    program.switch("--from-zero", "begin with zero gains and inputs instead of those of LQT")
    program.add("--save", "DIR", "write the limits to DIR/PROBLEM.json", type=Path)


class Program:
    """A program and its options, which are the parameters of its module's `run`."""

    def __init__(self, programs: Commands, name: str, text: str, example: str = "") -> None:
        self._parser = command(
            programs, name, _bench, help=text, example=f"python -m benchmarks {name} {example}"
        )
        add_json(self._parser, "print JSON instead of a table")
        self._parser.add_argument(
            "--out", type=Path, metavar="FILE", help="write the JSON there, too"
        )
        self._parser.set_defaults(program=name)

    def add(self, name: str, metavar: str | None, help: str, **how: Any) -> None:
        """An option with a value, or a word that has to be given."""
        self._parser.add_argument(name, metavar=metavar, help=help, **how)

    def switch(self, name: str, help: str) -> None:
        """An option without a value."""
        self._parser.add_argument(name, action="store_true", help=help)


def _bench(options: argparse.Namespace) -> int:
    given = {
        name: value
        for name, value in vars(options).items()
        if name not in ("command", "refuse", "program", "json", "out") and value is not None
    }
    module = importlib.import_module(f"benchmarks.{options.program}")
    result = module.run(**given)
    if options.out is not None:
        options.out.write_text(json.dumps(result, indent=1) + "\n")
    if options.json:
        print_json(result)
    else:
        print(module.text(result))
    return 0


if __name__ == "__main__":
    sys.exit(run(parser))
