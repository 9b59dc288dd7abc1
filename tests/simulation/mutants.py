# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Small changes of the protocols, each of which the simulation or their own tests must find.

    python -m tests.simulation.mutants [--sample N] [--seed S] [MODULE ...]

Of each module N mutants are drawn and tried, each in a process of its own, with a hard limit: first the
simulation runs SEEDS plans of `aimed` and of `draw`, then pytest the tests of the module. A mutant that
neither of them finds has survived, and is printed with its line. The exit code is 1 if less than LEAST
percent are found, those of `equivalent.ARGUED` not counted. Which mutants there are:
`operators.mutations`.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import functools
import importlib
import io
import multiprocessing
import os
import random
import sys
import time
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any
from unittest import mock

import pytest

from pdeloop.process.affinity import usable_cores
from tests.simulation.audit import undisturbed, verdict
from tests.simulation.equivalent import ARGUED
from tests.simulation.operators import mutations
from tests.simulation.plan import aimed, draw
from tests.support.interpreter import ROOT

SEEDS = 8
LIMIT = 60.0
"""Seconds that a mutant has, however busy the machine: one that takes longer waits for ever."""
_SIGNATURE = ("interfaces/test_signature.py", "interfaces/test_design_digest.py")
_TUNER = (
    "tuner/test_dispatch.py",
    "tuner/test_contradictions.py",
    "tuner/test_pauses.py",
    "tuner/test_session.py",
    *_SIGNATURE,
)
_PLANT = (
    "plant/test_lockstep.py",
    "plant/test_lockstep_pauses.py",
    "plant/test_lockstep_contradictions.py",
    "plant/test_taken_actions.py",
    *_SIGNATURE,
)
_CONTROLLER = (
    "controller/test_responder.py",
    "controller/test_exploration.py",
    "controller/test_run_memory.py",
    "controller/test_answered_steps.py",
    *_SIGNATURE,
)
_MEMORY = ("controller/test_law_batch.py", "controller/test_law_memory.py")
TESTS: dict[str, tuple[str, ...]] = {
    "tuner_node.dispatch": _TUNER,
    "tuner_node.chunk": _TUNER,
    "tuner_node.pair": ("tuner/test_trajectory_collector.py", *_TUNER),
    "tuner_node.session": ("tuner/test_participants.py", *_TUNER),
    "tuner_node.batch": ("tuner/test_batch.py", *_TUNER),
    "tuner_node.training_state": ("tuner/test_training_state.py", "tuner/test_session.py"),
    "pde_sim_node.lockstep": (*_PLANT, "plant/test_real_time.py"),
    "pde_sim_node.taken_actions": _PLANT,
    "controller_node.responder": (*_CONTROLLER, *_MEMORY),
    "controller_node.run_state": (*_CONTROLLER, *_MEMORY),
    "controller_node.law_batch": (*_MEMORY, *_CONTROLLER),
    "controller_node.exploration": _CONTROLLER,
    "pdeloop.messages.protocol": _SIGNATURE,
}
"""The modules that are changed, and their tests."""
ENDS = {4: "simulation", 2: "tests", 3: "time limit", 0: "survived"}
"""What found a mutant, by the exit code of its process."""
_NOT_PLANTED = 9
_RAISED = 1
"""How a process ends that could not judge its mutant, as Python has it."""


@dataclass(frozen=True)
class Mutant:
    """The change with this number in a module."""

    module: str
    number: int
    line: int
    there: str
    """The line, as it is."""
    how: str

    def __str__(self) -> str:
        return f"{self.module}:{self.line}: {self.how}: {self.there}"

    @property
    def argued(self) -> str:
        """Why nothing can find it; empty if that is not known."""
        return ARGUED.get((self.module, self.there, self.how), "")


def mutants_of(name: str) -> list[Mutant]:
    """All of a module, in the order of its lines."""
    source = _source(name)
    lines = source.splitlines()
    return [
        Mutant(name, number, change.line, lines[change.line - 1].strip(), change.how)
        for number, change in enumerate(mutations(ast.parse(source)))
    ]


def drawn(name: str, count: int, seed: int) -> list[Mutant]:
    """So many mutants of a module, or all of them."""
    every = mutants_of(name)
    rng = random.Random(f"{seed} {name}")
    return sorted(rng.sample(every, min(count, len(every))), key=lambda mutant: mutant.number)


def plant(mutant: Mutant) -> None:
    """Give the functions of the module, which others already refer to, the code of the mutant."""
    tree = ast.parse(_source(mutant.module))
    list(mutations(tree))[mutant.number].apply()
    ast.fix_missing_locations(tree)
    module = importlib.import_module(mutant.module)
    path = str(module.__file__)
    for code in _functions(compile(tree, path, "exec", dont_inherit=True)):
        if (function := _function(vars(module), code.co_qualname)) is not None:
            function.__code__ = code


@functools.cache
def _source(name: str) -> str:
    return Path(str(importlib.import_module(name).__file__)).read_text()


def _functions(code: CodeType) -> Iterator[CodeType]:
    """The functions of a module and the methods of its classes."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            if constant.co_flags & 0x0002:  # CO_NEWLOCALS: a function, not the body of a class
                yield constant
            else:
                yield from _functions(constant)


def _function(names: Any, qualified: str) -> FunctionType | None:
    """The function of that name, below what decorates it."""
    first, _, rest = qualified.partition(".")
    found = names.get(first)
    if rest:
        return _function(vars(found), rest) if isinstance(found, type) else None
    found = found.fget if isinstance(found, property) else found
    found = found.func if isinstance(found, functools.cached_property) else found
    while hasattr(found, "__wrapped__"):
        found = found.__wrapped__
    return found if isinstance(found, FunctionType) else None


def tested(files: tuple[str, ...]) -> bool:
    """True if the tests in these files, below `tests/`, pass."""
    words = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:randomly"]
    paths = [str(ROOT / "tests" / file) for file in files]
    silent = contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO())
    # The tests leave a temporary folder of theirs as that of the process, and later ones remove it.
    with silent[0], silent[1], mock.patch.dict(os.environ), mock.patch("tempfile.tempdir", None):
        return pytest.main([*words, *paths]) == pytest.ExitCode.OK


def judge(mutant: Mutant) -> None:
    """In a process of its own: end with what found it."""
    try:
        plant(mutant)
    except Exception as error:
        print(f"{mutant}: {error}", file=sys.stderr, flush=True)
        os._exit(_NOT_PLANTED)
    for seed in range(SEEDS):
        for plan in (aimed(seed), draw(seed)):
            if verdict(plan)[1]:
                os._exit(4)
    os._exit(0 if tested(TESTS[mutant.module]) else 2)


def tried(mutants: list[Mutant]) -> Iterator[tuple[Mutant, str]]:
    """Each mutant, and what found it. As many are tried at once as there are cores."""
    fork = multiprocessing.get_context("fork")  # which inherits what is imported and compiled
    waiting = deque(mutants)
    begun: list[tuple[Mutant, Any, float]] = []
    while waiting or begun:
        while waiting and len(begun) < len(usable_cores()):
            mutant = waiting.popleft()
            process = fork.Process(target=judge, args=(mutant,), daemon=True)
            process.start()
            begun.append((mutant, process, time.monotonic() + LIMIT))
        time.sleep(0.02)
        for entry in list(begun):
            mutant, process, deadline = entry
            if process.exitcode is None and time.monotonic() < deadline:
                continue
            assert process.exitcode != _NOT_PLANTED, f"{mutant} could not be planted"
            assert process.exitcode != _RAISED, f"{mutant} was not judged"
            end = ENDS[3] if process.exitcode is None else ENDS.get(process.exitcode, "tests")
            process.kill()
            process.join()
            begun.remove(entry)
            yield mutant, end


def prepare(modules: list[str]) -> None:
    """Import and compute what every mutant needs. AssertionError if the tests fail without any."""
    for module in TESTS:
        _source(module)  # as it is imported here, also where it is edited meanwhile
    for iterations in (0, 1, 4):
        for own_plant in (False, True):
            for law in ("affine", "observer") if iterations else ("affine",):
                undisturbed(iterations, own_plant, law)
    files = dict.fromkeys(file for module in modules for file in TESTS[module])
    assert tested(tuple(files)), "the tests fail without a mutant"
    for seed in range(SEEDS):
        for plan in (aimed(seed), draw(seed)):
            assert not verdict(plan)[1], f"seed {seed} fails without a mutant"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.simulation.mutants", description=__doc__)
    parser.add_argument("--sample", type=int, default=20, metavar="N", help="of each module [20]")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the sample [0]")
    parser.add_argument("--least", type=float, default=95.0, metavar="LEAST", help="percent [95]")
    parser.add_argument("modules", nargs="*", metavar="MODULE", default=list(TESTS))
    options = parser.parse_args()
    prepare(options.modules)
    total: Counter[str] = Counter()
    for module in options.modules:
        found: Counter[str] = Counter()
        for mutant, end in tried(drawn(module, options.sample, options.seed)):
            if end == "survived" and mutant.argued:
                end = "equivalent"
            found[end] += 1
            if end == "survived":
                print(f"  survived: {mutant}", flush=True)
        total += found
        print(f"{module:<34} {_score(found)}", flush=True)
    print(f"{'all':<34} {_score(total)}")
    return int(_share(total) < options.least or not total)


def _share(found: Counter[str]) -> float:
    """How many percent were found of those that can be."""
    possible = found.total() - found["equivalent"]
    return 100.0 * (possible - found["survived"]) / possible if possible else 100.0


def _score(found: Counter[str]) -> str:
    """How many were found, and by what."""
    return f"{_share(found):5.1f} %   " + ", ".join(
        f"{count} {end}" for end, count in sorted(found.items())
    )


if __name__ == "__main__":
    sys.exit(main())
