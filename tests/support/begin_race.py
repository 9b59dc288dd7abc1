# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Two processes that begin a training in one folder, in every order of what they write.

`python -m tests.support.begin_race [--every N]` forks two processes, A and B, for all n and m, or
only for each N-th m: A is let up to its n-th call that changes the folder or locks it, then B up to its
m-th, then A to its end, then B. It prints a line of JSON: how many orders there were, and a sentence
for each after which the folder does not tell of one training, that of the one process that was let
begin. Its exit code is 1 if there is such a sentence.

It does so for each way to begin: `run` begins as a tuner does, `create` as the command line does, which
starts a tuner afterwards.
"""

from __future__ import annotations

import argparse
import fcntl
import gc
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from pdeloop.messages.problem import read_problem
from tests.support.small import parameters
from tuner_node.build import build_training
from tuner_node.run_folder import RunFolder, RunFolderError
from tuner_node.run_store import RunWriter, open_run
from tuner_node.training import Training

MEMORY_DISK = Path("/dev/shm")
"""There fsync does not wait."""
POINTS = ("open", "replace", "unlink", "mkdir")
"""Calls before which a process waits; with them the taking of a lock."""


class Turns:
    """In a forked process: waits before each of its calls, until it is let."""

    def __init__(self, folder: Path, ready: int, go: int) -> None:
        self._folder, self._ready, self._go = str(folder), ready, go
        for name in POINTS:
            setattr(os, name, self._waiting(getattr(os, name)))
        fcntl.flock = self._waiting(fcntl.flock)

    def _waiting(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def waiting(subject: Any, *rest: Any, **more: Any) -> Any:
            if hasattr(subject, "fileno"):
                subject_path = Path(f"/proc/self/fd/{subject.fileno()}").readlink()
            else:
                subject_path = subject
            if str(subject_path).startswith(self._folder):
                os.write(self._ready, b".")
                os.read(self._go, 1)
            return call(subject, *rest, **more)

        return waiting


class Process:
    """A process that begins a training with this seed."""

    def __init__(self, folder: Path, seed: int, how: str) -> None:
        (self._ready, ready), (go, self._go) = os.pipe(), os.pipe()
        self._process = os.fork()
        if self._process == 0:
            os.close(self._ready), os.close(self._go)
            os._exit(begin(folder, seed, how, ready, go))
        os.close(ready), os.close(go)
        self.over = not os.read(self._ready, 1)

    def let(self, calls: int) -> int:
        """Let it make so many calls, or all that it has left; returns how many it made."""
        made = 0
        while not self.over and made < calls:
            os.write(self._go, b".")
            self.over = not os.read(self._ready, 1)
            made += 1
        return made

    def end(self) -> int:
        """Its exit code, after what is left."""
        self.let(10**6)
        os.close(self._ready), os.close(self._go)
        return os.waitstatus_to_exitcode(os.waitpid(self._process, 0)[1])


def begin(folder: Path, seed: int, how: str, ready: int, go: int) -> int:
    """In the forked process: 0 if it could begin, 1 if it was refused in a sentence, 70 otherwise."""
    values = {**VALUES, "seed": seed, "out": str(folder), "resume": False}
    out = folder.parent / f"identity-{seed}"
    try:
        Turns(folder, ready, go)
        with ExitStack() as locks:
            if how == "create":
                RunFolder(folder).create(values)
                locks.enter_context(RunFolder(folder).locked())
                identity = RunWriter(folder, values, TRAININGS[seed], warn=print).identity
            else:
                _, identity = open_run(values, TRAININGS[seed], locks, print)
        out.write_text(str(identity.run))
        return 0
    except RunFolderError:
        return 1
    except BaseException as error:
        out.write_text(repr(error))
        return 70


VALUES: dict[str, Any] = {}
TRAININGS: dict[int, Training] = {}
"""Those that have not begun, by their seed: a forked process begins a copy."""


def judged(folder: Path, codes: tuple[int, int]) -> str:
    """What is wrong with what they left behind; empty if nothing is."""
    told = {seed: folder.parent / f"identity-{seed}" for seed in (0, 1)}
    if sorted(codes) != [0, 1]:
        texts = [path.read_text() for path in told.values() if path.exists()]
        return f"exit codes {codes}, expected one process to begin: {texts}"
    winner = codes.index(0)
    known = json.loads((folder / "run.json").read_text())
    seeds = known["parameters"]["seed"], read_problem(folder / "parameters.yaml")["seed"]
    if seeds != (winner, winner):
        return f"run.json and parameters.yaml are of the seeds {seeds}, that of {winner} has begun"
    if str(known["run"]) != told[winner].read_text():
        return "run.json has another id than the training"
    return ""


def run(place: Path, every: int = 1) -> dict[str, dict[str, Any]]:
    """Every order, or a sample, of every way to begin."""
    VALUES.update(parameters())
    TRAININGS.update((seed, build_training({**VALUES, "seed": seed})) for seed in (0, 1))
    # What each of them loads, those that are forked find there.
    with ExitStack() as locks:
        first = {**VALUES, "out": str(place / "first"), "resume": False}
        open_run(first, build_training(first), locks, print)
    gc.disable(), gc.freeze()  # what a forked process touches is copied
    return {how: orders_of(place, how, every) for how in ("run", "create")}


def orders_of(place: Path, how: str, every: int) -> dict[str, Any]:
    """The orders of one way to begin. Of each n the first m is another one, so that all m occur."""
    wrong, orders, n, last = [], 0, 0, False
    while not last:
        m, ended = n % every, False
        while not ended:
            folder = place / "run"
            shutil.rmtree(folder, ignore_errors=True)
            for seed in (0, 1):
                (place / f"identity-{seed}").unlink(missing_ok=True)
            first, second = (Process(folder, seed, how) for seed in (0, 1))
            first.let(n)
            last = first.over
            second.let(m)
            ended = second.over
            codes = first.end(), second.end()
            orders += 1
            if sentence := judged(folder, codes):
                wrong.append(f"A after {n} calls, B after {m}: {sentence}")
            m += every
        n += 1
    return {"orders": orders, "wrong": wrong}


def command() -> int:
    """1 if a folder told of something else than one training."""
    words = argparse.ArgumentParser(prog="python -m tests.support.begin_race")
    words.add_argument("--every", type=int, default=1, metavar="N", help="only each N-th order")
    every = words.parse_args().every
    where = MEMORY_DISK if os.access(MEMORY_DISK, os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=where) as place:
        result = run(Path(place), every)
    print(json.dumps(result))
    return int(any(found["wrong"] or not found["orders"] for found in result.values()))


if __name__ == "__main__":
    sys.exit(command())
