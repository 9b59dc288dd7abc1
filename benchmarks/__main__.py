# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks PROGRAM`: the benchmarks.

A program is a module with two functions: `run`, whose parameters are its options, explained in its
docstring, and `text`, which shows the result to people. Keyword-only parameters are flags, the others
are words without one.
"""

import os
import sys

if __name__ == "__main__" and sys.path[0] == os.getcwd() and not sys.flags.safe_path:  # noqa: PTH109
    sys.path.append(sys.path.pop(0))  # as in pdeloop/__main__.py

import argparse
import importlib
import inspect
from collections.abc import Callable, Sequence
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from pdeloop.cli import run
from pdeloop.output import print_json
from pdeloop.process.module_path import PROJECT
from pdeloop.process.start import begin

PROGRAMS = {
    "first_run": "where the first `make run` in a fresh clone spends its time",
    "rtt": "rounds per second of the loop, compared with a bare ping-pong",
    "batch": "environment steps per second against the size of the batch",
    "train": "a whole training, over topics and in one process",
    "realtime": "jitter and missed deadlines at P1's 20 Hz and at 1 kHz",
    "baselines": "optimisers and other methods at equal rollouts, with intervals over seeds",
    "agents": "PPO, SAC and CrossQ that begin with a run's law, and without",
    "field_models": "the selected model of the whole field and its error",
    "choices": "how often the law that a training returns is the wrong one",
    "general": "held-out plants and initial fields: first law, adapted law and best known inputs",
    "gate": "costs of trainings, beside those of the same trainings before a change",
    "plans": "time of a step of the law predictive, on each shipped problem",
    "exported_step": "time of a step of the law neural, in C and in Python",
    "scale": "messages, bags, fits, memory and files as the state grows",
    "published": "tasks with published figures, which are shown beside ours",
    "optimum": "the best affine law and the best known inputs, by exact gradients",
    "study": "studies whose processes are killed, and what a study costs by itself",
    "overhead": "how much a recorder, a viewer or an open page of pdeloop monitor slows the loop",
    "estimator": "cost with an estimator that knows the true plant, from few sensors and with noise",
    "few_sensors": "trainings with few sensors and noise, seed by seed",
    "hidden_noise": "trainings whose noise is declared wrongly or not at all, seed by seed",
    "linearised": "cost of the LQR law of the exact linearisation at the target",
    "environments": "steps per second of the Gymnasium environments",
    "participants": "memory and processor time of many idle nodes",
    "kernel": "time of a step, compared with other implementations",
}


def parser() -> argparse.ArgumentParser:
    """The parser of all programs."""
    root = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Run a benchmark. What is compared takes turns in one run; figures are medians.",
        epilog="example: python -m benchmarks rtt --turns 3",
    )
    programs = root.add_subparsers(required=True, metavar="PROGRAM", parser_class=_Program)
    for name, words in PROGRAMS.items():
        programs.add_parser(name, help=words, formatter_class=argparse.RawDescriptionHelpFormatter)
    return root


class _Program(argparse.ArgumentParser):
    """The parser of a program, which is imported only when it is called."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        program = self.prog.rpartition(" ")[2]
        function = importlib.import_module(f"benchmarks.{program}").run
        self.description = documentation(function)[0]
        options = add_options(self, function)
        self.add_argument("--json", action="store_true", help="print JSON instead of a table")
        self.set_defaults(command=_measure, program=program, options=options)
        return super().parse_known_args(args, namespace)


def add_options(parser: argparse.ArgumentParser, function: Callable[..., Any]) -> list[str]:
    """Declare the parameters of a function as options; their names."""
    hints, (_, said) = get_type_hints(function), documentation(function)
    parameters = inspect.signature(function).parameters
    for name, parameter in parameters.items():
        default = parameter.default
        required = default is parameter.empty
        kind, several = _kind(hints[name])
        flag = parameter.kind is parameter.KEYWORD_ONLY
        word = f"--{name.replace('_', '-')}" if flag else name
        if kind is bool:
            parser.add_argument(word, action="store_true", help=said.get(name))
            continue
        choices = get_args(kind) or None
        shown = "" if required or default in (None, ()) else f"[{_words(default)}]"
        nargs = "+" if several and (flag or required) else "*" if several else None
        parser.add_argument(
            word,
            type=str if choices else kind,
            choices=choices,
            nargs="?" if nargs is None and not (flag or required) else nargs,
            metavar=None if choices else name.upper(),
            help=" ".join(filter(None, (said.get(name), shown))),
        )
    return list(parameters)


def documentation(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """The documentation of a function and of its parameters by name, `%` doubled for argparse."""
    text, _, parameters = (inspect.getdoc(function) or "").partition("\n\nParameters\n----------\n")
    said: dict[str, list[str]] = {}
    names: list[str] = []
    for line in parameters.partition("\n\n")[0].splitlines():
        if line.startswith(" "):
            for name in names:
                said[name].append(line.strip().replace("%", "%%"))
        else:
            names = line.partition(" :")[0].split(", ")
            said |= {name: [] for name in names}
    return text, {name: " ".join(lines) for name, lines in said.items()}


def _words(value: Any) -> str:
    """A value as one writes it after a flag."""
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _kind(hint: Any) -> tuple[Any, bool]:
    """The type of a value, and whether there may be several: int and True of Sequence[int]."""
    if get_origin(hint) in (Union, UnionType):  # or None
        return _kind(get_args(hint)[0])
    several = get_origin(hint) not in (None, Literal)
    return get_args(hint)[0] if several else hint, several


def _measure(options: argparse.Namespace) -> int:
    module = importlib.import_module(f"benchmarks.{options.program}")
    given = {name: getattr(options, name) for name in options.options}
    result = module.run(**{name: v for name, v in given.items() if v is not None and v != []})
    if options.json:
        print_json(result)
    else:
        print(module.text(result))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code of the program that the arguments name."""
    return run(parser, arguments)


if __name__ == "__main__":
    begin("benchmarks")
    sys.path.append(str(PROJECT))  # where the workers of a program find it, too
    sys.exit(main())
