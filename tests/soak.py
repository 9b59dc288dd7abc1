# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m tests.soak`: trainings under random faults, each compared bit for bit with a quiet one.

Every training runs as `pdeloop train` in processes of its own, with a relay that loses, repeats and
delays messages between plant and controller. Meanwhile nodes and the supervisor itself are killed,
stopped and continued, and checkpoints are damaged. A training that was cut down is continued with
`--resume`. At its end its policy and costs must be those of the same training in this process.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from pdeloop.in_process import LocalPair, train
from pdeloop.process.start import die_with
from pdeloop.training_run import resolve
from tests.support.interpreter import ROOT
from tests.support.relay.train import FAULTS
from tuner_node.build import build_training

NODES = ("pde_sim_node", "controller_node", "tuner_node", "relay")
KINDS, SHARES = ("kill", "stop", "supervisor", "checkpoint"), (0.4, 0.4, 0.1, 0.1)
"""What is done to processes, and how often."""
PAUSE = (0.1, 2.5)
"""Seconds between two faults: now within a start-up, now after some checkpoints."""
LIMIT = 600.0
"""Seconds that one training may take under faults."""


@dataclass
class SoakReport:
    """What a soak did and found."""

    seconds: float = 0.0
    trainings: int = 0
    mismatches: int = 0
    rollouts: int = 0
    """Of the adapt phase."""
    restarts: int = 0
    resumes: int = 0
    faults: Counter[str] = field(default_factory=Counter)


def soak(
    minutes: float,
    *,
    problem: str,
    iterations: int,
    seed: int,
    tell: Callable[[str], None],
    folder: Path | None = None,
    most: float = math.inf,
) -> SoakReport:
    """Run trainings of `problem` under faults for `minutes`, or until there were `most` of them.

    The last training is brought to its end undisturbed.

    tell: a line after each training.
    """
    report, rng = SoakReport(), np.random.default_rng(seed)
    began = time.monotonic()
    with contextlib.ExitStack() as stack:
        place = folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        place.mkdir(parents=True, exist_ok=True)

        def share() -> float:
            return max((time.monotonic() - began) / (60 * minutes), report.faults.total() / most)

        while share() < 1:
            number = report.trainings
            training = _Training(problem, iterations, seed + number, place / f"{number}", report)

            training.run(rng, lambda: share() < 1)
            report.trainings += 1
            same = training.matches()
            report.mismatches += not same
            tell(
                f"training {number + 1}: {'same policy' if same else 'MISMATCH'}, "
                f"{sum(report.faults.values())} faults so far"
            )
    report.seconds = time.monotonic() - began
    return report


class _Training:
    """One training under faults."""

    def __init__(
        self, problem: str, iterations: int, seed: int, out: Path, report: SoakReport
    ) -> None:
        # The optimiser that needs costs only and the one that needs trajectories take turns.
        # An update of model_based takes a second to compute, and is computed again after a kill.
        optimizer, share = (("two_point", 1), ("model_based", 10))[seed % 2]
        iterations = max(1, iterations // share)
        budget = {"iterations": iterations} if optimizer == "two_point" else {}
        budget = budget or {"rollouts": max(20, 2 * iterations)}
        self._options = {**budget, "seed": seed, "optimizer": optimizer}
        self._problem, self._out, self._report = problem, out, report
        self._log = out.with_suffix(".log")
        # Before the faults: it compiles what is not compiled, which a killed node would begin again.
        values = resolve(problem, self._options)
        self._quiet = build_training(values)
        train(self._quiet, LocalPair(values), lambda row: None)

    def run(self, rng: np.random.Generator, disturbing: Callable[[], bool]) -> None:
        """Start it, disturb it, and start it again until it has its result."""
        report = self._report
        options = [
            word for name, value in self._options.items() for word in (f"--{name}", f"{value}")
        ]
        fresh = (self._problem, *options, "--out", str(self._out))
        process = self._start(*fresh, "--record")
        limit = time.monotonic() + LIMIT
        while not (self._out / "result.json").exists():
            if time.monotonic() > limit:
                for pid, _ in self._nodes():  # each prints where its threads are
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGABRT)
                self._end_of(process, kill=True)
                said = self._log.read_text(errors="replace")[-20_000:]
                raise RuntimeError(f"a training did not end within {LIMIT:g} s: {said}")
            if process.poll() is not None:
                self._end_of(process)
                report.resumes += 1
                begun = (self._out / "parameters.yaml").exists()
                process = self._start(
                    *(("--resume", str(self._out)) if begun else fresh), "--record"
                )
            deadline = time.monotonic() + float(rng.uniform(*PAUSE))
            while time.monotonic() < deadline and process.poll() is None:
                time.sleep(0.05)
            if disturbing() and process.poll() is None and not (self._out / "result.json").exists():
                self._disturb(process, rng)
        self._end_of(process)
        report.restarts += self._log.read_text(errors="replace").count("; starting it again")
        result = json.loads((self._out / "result.json").read_text())
        report.rollouts += sum(seed["adaptation"] for seed in result["rollouts"])

    def matches(self) -> bool:
        """True if policy and costs are those of the quiet training, bit for bit."""
        quiet = self._quiet
        assert quiet.evaluation is not None
        result = json.loads((self._out / "result.json").read_text())
        costs = np.array([result["costs_by_field"][n] for n in ("none", "lqt", "adapted")])
        with np.load(self._out / "policy.npz", allow_pickle=False) as arrays:
            same = arrays["policy"].tobytes() == quiet.policies().tobytes()
        return same and costs.transpose(1, 0, 2).tobytes() == quiet.evaluation.tobytes()

    def _start(self, *arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.support.relay.train", *arguments]
        with self._log.open("ab") as log:
            return subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                # Nodes do not look for modules in the working directory; the relay is one of them.
                env={
                    **os.environ,
                    MARK: str(self._out),
                    "PYTHONPATH": str(ROOT),
                    "PYTHONFAULTHANDLER": "1",
                },
                start_new_session=True,
                preexec_fn=partial(_begin, os.getpid()),
            )

    def _disturb(self, supervisor: subprocess.Popen[bytes], rng: np.random.Generator) -> None:
        """One random fault."""
        nodes = self._nodes()
        kind = str(rng.choice(KINDS, p=SHARES))
        if kind in ("kill", "stop") and nodes:
            pid, name = nodes[int(rng.integers(len(nodes)))]
            with contextlib.suppress(ProcessLookupError):
                if kind == "kill":
                    os.kill(pid, signal.SIGKILL)
                else:
                    os.kill(pid, signal.SIGSTOP)
                    time.sleep(float(rng.choice((0.05, 0.3, 1.0, 4.0))))
                    os.kill(pid, signal.SIGCONT)
                self._report.faults[f"{'SIGKILL' if kind == 'kill' else 'SIGSTOP'} {name}"] += 1
        elif kind == "supervisor":
            number = signal.SIGKILL if rng.random() < 0.5 else signal.SIGINT
            _end(supervisor, number)
            self._report.faults[f"{number.name} supervisor"] += 1
        elif kind == "checkpoint":
            path = self._out / "checkpoint"
            if not (path.exists() and (self._out / "checkpoint.previous").exists()):
                return
            supervisor.kill()
            supervisor.wait(180.0)
            self._end_of(supervisor)
            (self._out / "checkpoint.new").unlink(missing_ok=True)
            path.write_bytes(path.read_bytes()[: int(rng.integers(1, 200))])
            self._report.faults["power cut with a truncated checkpoint"] += 1

    def _nodes(self) -> list[tuple[int, str]]:
        """Process id and name of every living node of this training."""
        mark, found = f"{MARK}={self._out}".encode(), []
        for entry in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if mark not in (entry / "environ").read_bytes():
                    continue
                command = (entry / "cmdline").read_bytes().decode(errors="replace")
                found += [(int(entry.name), n) for n in NODES if f"{n}\0" in command]
        return sorted(found)

    def _end_of(self, supervisor: subprocess.Popen[bytes], *, kill: bool = False) -> None:
        """Wait until the supervisor and all its nodes are gone."""
        if kill:
            supervisor.kill()
        supervisor.wait(180.0)
        deadline = time.monotonic() + 180.0
        while self._nodes():
            if time.monotonic() > deadline:
                raise RuntimeError(f"nodes outlive their supervisor: {self._nodes()}")
            time.sleep(0.02)


MARK = "PDELOOP_SOAK"
"""Environment variable by which the processes of one training are found."""


def _end(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """Signal a process until it ends: one that comes while Python starts may be lost in an import."""
    for _ in range(6):
        process.send_signal(number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(15.0)
            return
    raise RuntimeError(f"the supervisor did not end by {number.name}")


def _begin(parent: int) -> None:
    """For `preexec_fn`: it dies with its parent, and hears SIGINT, as in no shell's background."""
    die_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def text(report: SoakReport) -> str:
    """The report as people read it."""
    lines = [
        f"{report.trainings} trainings in {report.seconds:.0f} s, "
        f"{report.rollouts} rollouts of the adapt phase",
        f"mismatches: {report.mismatches}",
        f"nodes restarted: {report.restarts}, trainings resumed: {report.resumes}",
        "faults:",
        *(f"  {count:5d}  {kind}" for kind, count in sorted(report.faults.items())),
        "  and on the line between plant and controller: "
        + ", ".join(f"{name} {value}" for name, value in FAULTS.items()),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    words = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    words.add_argument("--minutes", type=float, default=20.0, metavar="N", help="[20]")
    words.add_argument("--problem", default="allen-cahn", metavar="PROBLEM", help="[allen-cahn]")
    words.add_argument("--iterations", type=int, default=100, metavar="N", help="of each [100]")
    words.add_argument("--seed", type=int, default=0, metavar="S", help="of faults and trainings")
    found = soak(**vars(words.parse_args()), tell=lambda line: print(line, flush=True))
    print(text(found))
    sys.exit(bool(found.mismatches))
