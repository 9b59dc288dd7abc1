"""`pdeloop problems`."""

from __future__ import annotations

import argparse

from bringup.commands.common import Commands
from loop_interfaces.parameters import read_yaml
from loop_interfaces.problem import shipped_problems


def add(commands: Commands) -> None:
    """The command `problems`."""
    problems = commands.add_parser(
        "problems",
        help="list the shipped problems",
        description="List the shipped problems.",
    )
    problems.set_defaults(command=_problems)


def _problems(options: argparse.Namespace) -> int:
    width = max(len(name) for name in shipped_problems())
    for name, path in shipped_problems().items():
        values = read_yaml(path)
        first = path.read_text().splitlines()[0].removeprefix("# ").split("   ")[0]
        size = f"{values['n_z']} states, {values['n_a']} actuators"
        steps = f"{values['horizon']} steps of {values['sample_time']:g} s"
        print(f"{name:<{width}}  {first}\n{'':<{width}}  {size}, {steps}; {path}")
    return 0
