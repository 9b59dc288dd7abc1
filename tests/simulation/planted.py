# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Bugs that are planted in the protocols, one after the other, for the simulation to find.

    python -m tests.simulation.planted [--seeds N] [NAME ...]

A bug is a piece of a function's source and what stands there instead, mostly a check that is gone.
The simulation runs the plans of `aimed` and `draw` in turn until a history is wrong, for N seeds at
most. It prints the seed of each bug, and ends with exit code 1 if one was not found.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdeloop.study.executors import processes
from tests.simulation.audit import undisturbed, verdict
from tests.simulation.plan import aimed, draw

SEEDS = 120


@dataclass(frozen=True)
class Bug:
    """In `module`, within a method, `there` is replaced."""

    module: str
    there: str
    instead: str


_TAKEN, _LOCKSTEP = "pde_sim_node.taken_actions", "pde_sim_node.lockstep"
_DISPATCH, _PAIR = "tuner_node.dispatch", "tuner_node.pair"
_RESPONDER, _RUN = "controller_node.responder", "controller_node.run_state"
_LAW = "controller_node.law_batch"
BUGS = {
    "plant: actions of another episode": Bug(
        _LOCKSTEP,
        "frame.run != self.run or frame.episode != self.episode:",
        "frame.run != self.run:",
    ),
    "plant: actions of another run": Bug(
        _LOCKSTEP,
        "frame.run != self.run or frame.episode != self.episode:",
        "frame.episode != self.episode:",
    ),
    "plant: actions for another plant": Bug(
        _LOCKSTEP, "if frame.plant != self._fingerprint:\n", "if False:\n"
    ),
    "plant: actions of another step": Bug(
        _LOCKSTEP, "awaited = frame.step == plant.step_index", "awaited = True"
    ),
    "plant: two actions": Bug(
        _TAKEN, "return two_actions(action) if self.episode.contradicted_by(action) else", "return"
    ),
    "plant: unsigned actions": Bug(_TAKEN, "if not self.is_signed(action):", "if False:"),
    "plant: late actions": Bug(_TAKEN, "if not ended.contradicted_by(action):", "if True:"),
    "plant: late actions, if signed": Bug(
        _TAKEN, "if self.signs and signature_in(", "if self.signs or signature_in("
    ),
    "plant: late starts": Bug(
        _TAKEN, "if ended is None or not ended.started_otherwise(rows, signature):", "if True:"
    ),
    "plant: two starts": Bug(
        _LOCKSTEP,
        "if present and self.active and episode.started_otherwise(rows, signed):",
        "if False:",
    ),
    "plant: starts of an earlier episode": Bug(
        _LOCKSTEP, "if frame.episode <= self.episode:", "if frame.episode == self.episode:"
    ),
    "plant: actions before their state": Bug(
        _LOCKSTEP,
        "if self._phase is Phase.READY:\n            self.counters",
        "if False:\n            self.counters",
    ),
    "plant: a cost is void once": Bug(_TAKEN, "values[:, CostColumn.ENDED] = VOID", "pass"),
    "tuner: answers of another run": Bug(_DISPATCH, "if frame.run != self.run:\n", "if False:\n"),
    "tuner: answers of another episode": Bug(
        _DISPATCH, "if not known.runs(frame.episode):", "if False:"
    ),
    "tuner: two answers": Bug(
        _PAIR, "if not void and digest(answer.values) != taken:", "if False:"
    ),
    "tuner: costs that are taken back": Bug(
        _PAIR, "if void and answer.step == step and not self.runs(answer.episode):", "if False:"
    ),
    "tuner: void costs": Bug(
        _DISPATCH, "if (frame.values[:, CostColumn.ENDED] == VOID).any():", "if False:"
    ),
    "tuner: costs of another plant": Bug(_PAIR, "if cost.plant != plant:\n", "if False:\n"),
    "tuner: models of another plant": Bug(
        _DISPATCH,
        "if self.plant not in (UNKNOWN_PLANT, frame.plant):\n            raise",
        "if False:\n            raise",
    ),
    "tuner: samples of another episode": Bug(
        _PAIR, "or not self.runs(frame.episode):", "or False:"
    ),
    "tuner: lost samples": Bug(_PAIR, "return self.samples.lost(", "return 0 * self.samples.lost("),
    "tuner: episodes that the controller takes back": Bug(
        _PAIR, "if not failure.retry and not repeated and self.used(failure.episode):", "if False:"
    ),
    "tuner: models of another controller": Bug(
        _PAIR,
        "if signed and signature_in(model.time) not in",
        "if False and signature_in(model.time) not in",
    ),
    "controller: states of another episode": Bug(
        _RUN, "start.episode == frame.episode else None", "True else None"
    ),
    "controller: starts of an earlier episode": Bug(
        _RESPONDER, "if known is not None and frame.episode < known.episode:", "if False:"
    ),
    "controller: policies of another episode": Bug(
        _RUN, "if policy.episode == episode]", "if True]"
    ),
    "controller: a memory that it has not": Bug(_LAW, "elif step != self._next:", "elif False:"),
    "controller: a memory of another policy": Bug(
        _RESPONDER, "if known is None or known[0] != made_from:", "if known is None:"
    ),
    "controller: costs beyond what it answered": Bug(
        "controller_node.run_state", "if episode != known or cost.step >= step:", "if True:"
    ),
}
"""By what is not checked any more, or goes wrong."""
OPEN = (
    "plant: actions for another plant",
    "plant: two actions",
    "plant: unsigned actions",
    "plant: two starts",
    "plant: actions before their state",
    "tuner: costs of another plant",
    "tuner: models of another plant",
    "tuner: samples of another episode",
    "tuner: episodes that the controller takes back",
    "controller: starts of an earlier episode",
    "controller: costs beyond what it answered",
)
"""Those that the simulation was not seen to find: another check stands behind the one that is gone, or
no plan comes at the moment at which it matters. Unit tests of the protocols hold them."""


@contextmanager
def planted(bug: Bug) -> Iterator[None]:
    """The bug is there for the time of the block."""
    module = importlib.import_module(bug.module)
    assert module.__file__ is not None
    source = Path(module.__file__).read_text()
    assert source.count(bug.there) == 1, f"{bug.there!r} is there {source.count(bug.there)} times"
    line = source[: source.index(bug.there)].count("\n") + 1
    owner, function = _around(ast.parse(source), line)
    lines = source.replace(bug.there, bug.instead).splitlines()
    first = min([function.lineno, *(d.lineno for d in function.decorator_list)])
    end = (function.end_lineno or line) + bug.instead.count("\n") - bug.there.count("\n")
    made: dict[str, Any] = {}
    exec(textwrap.dedent("\n".join(lines[first - 1 : end])), vars(module), made)
    kind = getattr(module, owner)
    before = vars(kind)[function.name]
    setattr(kind, function.name, made[function.name])
    try:
        yield
    finally:
        setattr(kind, function.name, before)


def _around(tree: ast.Module, line: int) -> tuple[str, ast.FunctionDef]:
    """The class and the method that a line belongs to."""
    for owner in tree.body:
        for function in owner.body if isinstance(owner, ast.ClassDef) else ():
            within = function.lineno <= line <= (function.end_lineno or 0)
            if isinstance(function, ast.FunctionDef) and within:
                return owner.name, function
    raise ValueError(f"line {line} is in no method")


def found(name: str, seeds: int = SEEDS) -> tuple[str, int | None, str]:
    """The bug's name, the seed at which the simulation finds it, None if it does not, and how."""
    for iterations in (0, 1, 4):
        for own_plant in (False, True):
            for law in ("affine", "observer") if iterations else ("affine",):
                undisturbed(iterations, own_plant, law)  # before anything is planted
    with planted(BUGS[name]):
        for seed in range(seeds):
            for plan in (aimed(seed), draw(seed)):
                _, reason = verdict(plan)
                if reason:
                    return name, seed, reason
    return name, None, ""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.simulation.planted", description=__doc__)
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N")
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        default=[name for name in BUGS if name not in OPEN],
        help="of a bug [all that the simulation finds]",
    )
    options = parser.parse_args()
    missed = 0
    with processes() as pool:
        for name, seed, reason in pool.map(
            found, options.names, [options.seeds] * len(options.names)
        ):
            missed += seed is None
            told = (
                f"not found in {options.seeds} seeds" if seed is None else f"seed {seed}: {reason}"
            )
            print(f"{name:<50} {told[:100]}", flush=True)
    print(f"{len(options.names) - missed} of {len(options.names)} planted bugs found")
    return int(missed > 0 or not options.names)


if __name__ == "__main__":
    sys.exit(main())
