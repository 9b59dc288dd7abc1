"""`pdeloop new`."""

from __future__ import annotations

import argparse
from pathlib import Path

from pdeloop.commands.common import Commands, command


def add(commands: Commands) -> None:
    """The command `new`."""
    new = command(
        commands,
        "new",
        _new,
        help="class, YAML and test of an own PDE, to begin with",
        description="Write a folder with the class, the YAML file and the test of a PDE that runs, to "
        "be changed into your own (docs/bring-your-own.md).",
        example="pdeloop new my-pde",
    )
    new.add_argument("name", metavar="NAME", help="name of the problem and of its new folder")


def _new(options: argparse.Namespace) -> int:
    from pdeloop.new_problem import write

    files, equation = write(options.name, Path())
    for file in files:
        print(file)
    print(f"next: pdeloop check {files[1]} --equation {equation} --picture {options.name}.png")
    print(f"      pdeloop train {files[1]} --equation {equation}")
    return 0
