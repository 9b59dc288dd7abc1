# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Trainings that are killed, or refused by the disk, at each call that changes their folder.

`python -m tests.support.crash_points FOLDER [KIND ...]` trains a small problem once undisturbed. Then,
for each n until a training comes to its end, it lets the n-th call fail in each of these ways:

kill     SIGKILL before the call; the training that continues is killed once more. Not after fsync,
         which changes nothing that a killed process leaves
torn     SIGKILL in fsync, when half of the file's content is on the disk
EIO      fsync and rename are refused
ENOSPC   open is refused

and the training is continued until it is done. It prints a line of JSON: how many failures of each way
there were, and a sentence for each training that did not come to the same policy.
"""

from __future__ import annotations

import errno
import gc
import io
import itertools
import json
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pdeloop.cli import DONE, FAILED, main, parser
from pdeloop.training_run import load_compiled, resolve
from tests.support.small import SMALL
from tuner_node import run_store

CHANGING = ("open", "fsync", "replace", "rename", "unlink", "mkdir")
KINDS = {
    "kill": CHANGING,
    "torn": ("fsync",),
    "EIO": ("fsync", "replace", "rename"),
    "ENOSPC": ("open",),
}
"""Ways to fail, and the calls that can fail so."""


BUDGET = ["--iterations", "1", "--optimizer", "two_point"]
"""What is computed in a training matters little here: what it writes does not depend on it."""


class Disk:
    """Counts this process's calls that change something in `folder`, and fails the n-th."""

    def __init__(self, folder: Path, fail_at: int, kind: str) -> None:
        self._folder, self._fail_at, self._kind = str(folder), fail_at, kind
        self.calls: list[str] = []
        for name in CHANGING:
            setattr(os, name, self._counted(getattr(os, name), name))
        io.open = self._counted(io.open, "open")  # of Path.open

    def _counted(self, call: Callable[..., Any], name: str) -> Callable[..., Any]:
        def counted(subject: Any, *rest: Any, **more: Any) -> Any:
            if self._is_ours(subject, name, rest):
                self.calls.append(name)
                if len(self.calls) == self._fail_at:
                    self._fail(name, subject)
            return call(subject, *rest, **more)

        return counted

    def _is_ours(self, subject: Any, name: str, rest: tuple[Any, ...]) -> bool:
        if isinstance(subject, int):
            if name == "open":  # a file object on what is open
                return False
            subject = Path(f"/proc/self/fd/{subject}").readlink()
        if name == "open" and (not rest or rest[0] in ("r", "rb", os.O_RDONLY)):
            return False
        return str(subject).startswith(self._folder)

    def _fail(self, name: str, subject: Any) -> None:
        if self._kind in ("EIO", "ENOSPC"):
            number = getattr(errno, self._kind)
            raise OSError(number, os.strerror(number), str(subject))
        if self._kind == "torn" and Path(f"/proc/self/fd/{subject}").is_file():
            os.ftruncate(subject, os.fstat(subject).st_size // 2)
        os.kill(os.getpid(), signal.SIGKILL)


def forked(log: Path, task: Callable[[], int]) -> int:
    """The exit code of `task` in a process of its own, or minus the signal that killed it."""
    process = os.fork()
    if process:
        return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(file, 1)
    os.dup2(file, 2)
    code = 70
    try:
        code = task()
        sys.stdout.flush()
    finally:
        os._exit(code)


def training(out: Path, fail_at: int = 0, kind: str = "kill") -> Callable[[], int]:
    """A training in `out`, begun or continued."""

    def task() -> int:
        run_store.CHECKPOINT_PERIOD, run_store.CHECKPOINT_SHARE = 0.0, 1e9
        run_store.RunWriter.keep = seldom(run_store.RunWriter.keep)  # type: ignore[method-assign]
        begun = (out / "parameters.yaml").exists()
        how = ["--resume", str(out)] if begun else [str(problem(out)), "--out", str(out)]
        disk = Disk(out, fail_at, kind)
        code = main(["train", *how, "--in-process", *([] if begun else BUDGET)])
        (out.parent / "calls").write_text(" ".join(disk.calls))
        return code

    return task


def problem(out: Path) -> Path:
    """The small problem with episodes as short as its model allows: the files are the same."""
    path = out.parent / "small.yaml"
    if not path.exists():
        path.write_text(SMALL.read_text().replace("horizon: 30", "horizon: 12"))
    return path


def seldom(keep: Callable[..., None]) -> Callable[..., None]:
    """`keep` for the first two checkpoints and the last: none before it, one, and two."""
    times = 0

    def kept(*of: Any, **how: Any) -> None:
        nonlocal times
        times += 1
        if times <= 2 or how.get("force"):
            keep(*of, **how)

    return kept


def judged(out: Path, n: int, kind: str, policy: bytes) -> str | None:
    """What is wrong after a failure at the n-th call; None if nothing is."""
    log = out.parent / "log"
    log.unlink(missing_ok=True)
    codes = [forked(log, training(out, n, kind))]
    while not (out / "result.json").exists() and len(codes) < 4:
        again = n % 7 + 1 if kind == "kill" and len(codes) == 1 else 0
        codes.append(forked(log, training(out, again)))
    where = f"{kind} at call {n}, exit codes {codes}"
    text = log.read_text()
    if "Traceback" in text:
        return f"{where}: a traceback: {text}"
    if not set(codes) <= {DONE, FAILED, -signal.SIGKILL} or not (out / "result.json").exists():
        return f"{where}: {text}"
    if (out / "policy.npz").read_bytes() != policy:
        return f"{where}: another policy"
    return None


def run(folder: Path, kinds: tuple[str, ...]) -> dict[str, Any]:
    """Every failure, one after the other."""
    parser()  # imports what each training needs
    out = folder / "run"
    load_compiled(resolve(str(problem(out)), {}))
    gc.freeze()  # what a fork touches is copied
    assert forked(folder / "log", training(out)) == 0, (folder / "log").read_text()
    policy = (out / "policy.npz").read_bytes()
    calls = (folder / "calls").read_text().split()
    failures = [
        (n, kind)
        for kind in kinds
        for n, (before, call) in enumerate(itertools.pairwise(["", *calls]), 1)
        if call in KINDS[kind] and (kind, before) != ("kill", "fsync")
    ]
    wrong = []
    for n, kind in failures:
        shutil.rmtree(out)
        if sentence := judged(out, n, kind, policy):
            wrong.append(sentence)
    return {"failures": Counter(kind for _, kind in failures), "wrong": wrong}


if __name__ == "__main__":
    print(json.dumps(run(Path(sys.argv[1]), tuple(sys.argv[2:]) or KINDS)))
