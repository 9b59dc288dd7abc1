# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks published TASK`: tasks with published figures, side by side."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple, TypeAlias

import pdeloop
from benchmarks.tasks import (
    boundary,
    convection,
    convection_layer,
    falling_film,
    kuramoto_sivashinsky,
    kuramoto_sivashinsky_four,
    kuramoto_sivashinsky_sensors,
    lid,
    tokamak,
)
from benchmarks.tasks.common import Row

__all__ = ["run", "text"]

Name: TypeAlias = Literal[
    "reaction-diffusion",
    "transport",
    "lid",
    "kuramoto-sivashinsky-eight",
    "kuramoto-sivashinsky-sensors",
    "kuramoto-sivashinsky-four",
    "film",
    "convection",
    "rbc2d",
    "tokamak",
]


class Task(NamedTuple):
    """A published task."""

    rows: Callable[[list[int], int], Iterable[Row]]
    source: str
    minutes: float
    """That its table takes on two idle cores."""


TASKS: dict[str, Task] = {
    "reaction-diffusion": Task(boundary.reaction_diffusion, "PDEControlGym, notebook", 30),
    "transport": Task(boundary.transport, "PDEControlGym, notebook", 5),
    "lid": Task(lid.rows, "PDEControlGym, NavierStokes", 3),
    "kuramoto-sivashinsky-eight": Task(kuramoto_sivashinsky.rows, "DA-RL, whole field", 30),
    "kuramoto-sivashinsky-sensors": Task(
        kuramoto_sivashinsky_sensors.rows, "DA-RL, few sensors", 30
    ),
    "kuramoto-sivashinsky-four": Task(kuramoto_sivashinsky_four.rows, "Werner and Peitz", 30),
    "film": Task(falling_film.rows, "beacon, shkadov-v0", 2),
    "convection": Task(convection.rows, "beacon, rayleigh-v0", 12),
    "rbc2d": Task(convection_layer.rows, "FluidGym, RBC2D-easy-v0", 15),
    "tokamak": Task(tokamak.rows, "Gym-TORAX, IterHybrid-v0", 40),
}


def run(
    task: Name | None = None, *, rollouts: list[int] | None = None, seeds: int = 3
) -> list[Row]:
    """Measure controllers on a published task, and show the published figures beside them.

    Parameters
    ----------
    task
        The published task; a list of all of them if not given.
    rollouts
        Budgets of the trainings; 1: the first law, from one exploration. [1 5 20 80]
    seeds
        Number of seeds of what is random; the worst seed is shown in brackets.
    """
    if task is None:
        return [
            {"task": name, "source": known.source, "minutes": known.minutes}
            for name, known in TASKS.items()
        ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pdeloop.IdentifiabilityWarning)
        found = []
        for row in TASKS[task].rows([1, 5, 20, 80] if rollouts is None else rollouts, seeds):
            print(*row.values(), sep=" | ", file=sys.stderr, flush=True)
            found.append(row)
        return found


def text(rows: list[Row]) -> str:
    """A table in Markdown."""
    names = list(rows[0])
    lines = [f"| {' | '.join(name.strip() for name in names)} |", "|---" * len(names) + "|"]
    lines += [f"| {' | '.join(str(row[name]) for name in names)} |" for row in rows]
    return "\n".join(lines)
