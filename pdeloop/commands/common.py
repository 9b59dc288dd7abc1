# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Declaration of commands."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from pdeloop.messages.own_code import identity
from pdeloop.messages.parameters import LAW, OPTIMIZER, PROBLEM, TUNER, flags
from pdeloop.messages.problem import shipped_problems
from pdeloop.messages.spec import ParameterError, Spec

if TYPE_CHECKING:
    from pdeloop.finished_run import FinishedRun

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""The collection to which a command adds its parser."""
DEFAULTS = {spec.name: spec for spec in TUNER}
"""The tuner's parameters by name: their defaults, ranges and meanings."""
_METAVAR = {int: "N", list: "X,X,..."}


def command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], int] | None,
    *,
    help: str,
    description: str = "",
    example: str,
) -> argparse.ArgumentParser:
    """Declare a command, or a group of commands (without `run`); every one shows an example.

    description: `help` as a sentence if not given. A handler refuses options that do not go together
    by `options.refuse(text)`, which ends as argparse does.
    """
    parser = commands.add_parser(
        name,
        help=help,
        description=description or f"{help[0].upper()}{help[1:]}.",
        epilog=f"example: {example}",
    )
    if run is not None:
        parser.set_defaults(command=run, refuse=parser.error, prog=parser.prog)
    return parser


def a_path(text: str) -> Path:
    """The type of an argument that is a path: not empty, as from an unset variable, and UTF-8."""
    if not text:
        raise argparse.ArgumentTypeError("it is empty; expected a path")
    try:
        str(Path(text).absolute()).encode()
    except UnicodeEncodeError:  # YAML, JSON and HTML that name it could not be written
        raise argparse.ArgumentTypeError(
            f"{text!a} is not valid UTF-8; choose another name"
        ) from None
    return Path(text)


_OWN_CODE = {
    "equation": "the problem's PDE",
    "plant": "a plant instead of an equation, the file of an FMU, or process:COMMAND",
    "optimizer": "the method of the adapt phase",
    "law": "the control law",
}
_NAMED_ANEW = ("optimizer", "law")
"""User code whose flag is also among those of a group."""


def spellings(flag: str) -> tuple[str, ...]:
    """A flag as the code spells it and, where that differs, as British English does."""
    return tuple(dict.fromkeys((flag, flag.replace("optimizer", "optimiser"))))


def add_own_code(
    parser: argparse._ActionsContainer, words: Sequence[str] = tuple(_OWN_CODE)
) -> None:
    """The flags --equation, --plant, --optimizer and --law, or some of them; see `allow_own_code`."""
    for word in words:
        what = _OWN_CODE[word]
        parser.add_argument(
            *spellings(f"--{word}"),
            metavar="NAME",
            help=f"{what}; your own code, 'file.py:Class' or 'package.module:Class', runs only if "
            "it is named here",
        )


def allow_own_code(options: argparse.Namespace) -> dict[str, str]:
    """Allow the code that --equation, --plant, --optimizer or --law names; the parameters given."""
    from pde_sim_node.equations import OWN_EQUATIONS
    from pde_sim_node.plants.loading import OWN_PLANTS
    from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
    from pdeloop.method.laws.registry import OWN_LAWS

    given = {}
    for kind in (OWN_EQUATIONS, OWN_PLANTS, OWN_OPTIMIZERS, OWN_LAWS):
        named = getattr(options, kind.word, None)
        if named is not None:
            given[kind.word] = kind.allow(named)
    return given


def forget_named_anew(given: dict[str, object], own: Mapping[str, str]) -> None:
    """Take the code that a run to be continued has, which has to be named again, out of its flags."""
    for word in _NAMED_ANEW:
        if ":" in own.get(word, ""):
            del given[word]


def refuse_other_code(options: argparse.Namespace, *runs: Mapping[str, object]) -> None:
    """ParameterError if a flag names user code that none of these runs' parameters name."""
    for word in _OWN_CODE:
        named = getattr(options, word, None)
        known = sorted({str(values.get(word, "")) for values in runs})
        if named is not None and identity(named) not in map(identity, known):
            theirs = ", ".join(filter(None, known)) or "none"
            raise ParameterError(
                f"--{word} is {named}, but that of the run is {theirs}; leave it out, or name the "
                "run's"
            )


def finished_run(options: argparse.Namespace) -> FinishedRun:
    """The run in the folder that a command names, with the code that its flags allow."""
    from pdeloop.finished_run import load_run

    allow_own_code(options)
    run = load_run(options.folder)
    refuse_other_code(options, run.values)
    return run


def add_problem(
    parser: argparse._ActionsContainer, help: str, name: str = "problem", nargs: str = "?"
) -> None:
    """The positional argument PROBLEM, which shells complete to shipped names and YAML files."""
    action = parser.add_argument(name, nargs=nargs, metavar="PROBLEM", help=help)

    def complete(prefix: str, **_: object) -> list[str]:
        from argcomplete.completers import FilesCompleter

        return [*shipped_problems(), *FilesCompleter(["yaml"])(prefix)]

    action.completer = complete  # type: ignore[attr-defined]  # as argcomplete asks for it


def add_flags(parser: argparse._ActionsContainer, group: str) -> None:
    """The flags of a group of parameters (pdeloop.messages.parameters)."""
    for spec in flags(group):
        own = "the problem's, or " if spec in PROBLEM else ""
        action = parser.add_argument(
            *spellings(spec.flag),
            type=_word if spec.choices else str if spec.numbers else spec.type,
            choices=spec.choices or None,
            metavar=None if spec.choices else _METAVAR.get(spec.type, "X"),
            help=f"{spec.description} [{own}{spec.default}]".replace("%", "%%"),
        )
        if spec in (OPTIMIZER, LAW):
            action.completer = partial(_offered, spec)  # type: ignore[attr-defined]


def _offered(spec: Spec, prefix: str, **_: object) -> list[str]:
    """The names of the optimisers or laws, for the completion of the shells."""
    from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
    from pdeloop.method.laws.registry import OWN_LAWS

    return (OWN_OPTIMIZERS if spec is OPTIMIZER else OWN_LAWS).offered()


def given_flags(options: argparse.Namespace) -> dict[str, object]:
    """The parameters whose flags a command has and was given, by name."""
    named = [(spec, getattr(options, spec.name, None)) for spec in flags()]
    return {
        spec.name: spec.parse(value) if spec.numbers else value
        for spec, value in named
        if value is not None
    }


def _word(text: str) -> str:
    """two-point as well as two_point."""
    return text.replace("-", "_")


def add_json(parser: argparse._ActionsContainer, what: str = "print JSON") -> None:
    """The flag --json: data on stdout, and nothing else there."""
    parser.add_argument("--json", action="store_true", help=what)
