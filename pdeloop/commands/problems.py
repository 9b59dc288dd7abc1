# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop problems`."""

from __future__ import annotations

import argparse
from typing import Any

from pdeloop.commands.common import Commands, add_json, command
from pdeloop.messages.problem import read_problem, shipped_problems
from pdeloop.output import print_json


def add(commands: Commands) -> None:
    """The command `problems`."""
    problems = command(
        commands,
        "problems",
        _problems,
        help="list the shipped problems",
        description="List the shipped problems and their files, which serve as templates for your own.",
        example="pdeloop problems",
    )
    add_json(problems)


def _problems(options: argparse.Namespace) -> int:
    found = [_described(name) for name in shipped_problems()]
    if options.json:
        print_json(found)
        return 0
    width = max(len(one["name"]) for one in found)
    for one in found:
        size = f"{one['n_z']} states, {one['n_a']} actuators"
        steps = f"{one['horizon']} steps of {one['sample_time']:g} s"
        print(f"{one['name']:<{width}}  {one['description']}")
        print(f"{'':<{width}}  {size}, {steps}; {one['file']}")
    return 0


def _described(name: str) -> dict[str, Any]:
    path = shipped_problems()[name]
    values = read_problem(path)
    first = path.read_text().splitlines()[0].removeprefix("# ").split("   ")[0]
    numbers = {key: values[key] for key in ("n_z", "n_a", "horizon", "sample_time")}
    return {"name": name, "description": first, "file": str(path), **numbers}
