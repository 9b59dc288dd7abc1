# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Trainings that are killed, or refused by the disk, at each call that concerns their folder.

`python -m tests.support.crash_points [KIND ...] [--most N]` trains a small problem once undisturbed.
Then, for each n until a training comes to its end, or for N of them in each way, it lets the n-th call
fail in each of these ways:

kill     SIGKILL before the call; the training that continues is killed once more. Not after fsync,
         which changes nothing that a killed process leaves
torn     SIGKILL in fsync, when half of the file's content is on the disk
power    a power cut before the call: a real ext4 file system keeps only what was synced (needs root)
EIO      write, fsync, close and rename are refused
ENOSPC   open is refused
again    a training that continues gets EIO at any call, of reading too, from locking to the end
ESTALE   the same with ESTALE, as from a file server that was started again
often    one training is killed and continued two hundred times, each time at another call

and the training is continued until it is done. It prints a line of JSON: how many failures of each way
there were, and a sentence for each training that did not come to the same policy.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import gc
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pdeloop.cli import DONE, FAILED, main
from pdeloop.training_run import load_compiled, resolve
from tests.support.failing_calls import CHANGING, EVERY, FailingCalls
from tests.support.lossy_disk import LossyDisk
from tests.support.mounts import mountable
from tests.support.small import SMALL
from tuner_node import run_store

KINDS = {
    "kill": CHANGING,
    "torn": ("fsync",),
    "power": CHANGING,
    "EIO": ("write", "fsync", "close", "replace", "rename"),
    "ENOSPC": ("open",),
    "again": EVERY,
    "ESTALE": EVERY,
    "often": (),
}
"""Ways to fail, and the calls that can fail so."""
MEMORY_DISK = Path("/dev/shm")
"""There fsync does not wait; what is on the disk at a crash is decided here."""
RESUMES = 200
CONTINUED = ("again", "ESTALE")
"""The training that fails so continues one that was killed."""
CODES = {"EIO": errno.EIO, "ENOSPC": errno.ENOSPC, "again": errno.EIO, "ESTALE": errno.ESTALE}


BUDGET = ["--iterations", "1", "--optimizer", "two_point"]
"""What is computed in a training matters little here: what it writes does not depend on it."""


def failing(kind: str, disk: LossyDisk | None) -> Callable[[str, Any], None]:
    """How a call fails in this way."""

    def fail(name: str, subject: Any) -> None:
        if kind in CODES:
            raise OSError(CODES[kind], os.strerror(CODES[kind]), str(subject))
        if kind == "torn" and Path(f"/proc/self/fd/{subject}").is_file():
            os.ftruncate(subject, os.fstat(subject).st_size // 2)
        if disk:
            disk.cut_power()
        os.kill(os.getpid(), signal.SIGKILL)

    return fail


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


def training(
    out: Path, place: Path, fail_at: int, kind: str, disk: LossyDisk | None
) -> Callable[[], int]:
    """A training in `out`, begun or continued."""

    def task() -> int:
        run_store.CHECKPOINT_PERIOD, run_store.CHECKPOINT_SHARE = 0.0, 1e9
        run_store.RunWriter.keep = seldom(run_store.RunWriter.keep)  # type: ignore[method-assign]
        begun = (out / "parameters.yaml").exists()
        how = ["--resume", str(out)] if begun else [str(problem(place)), "--out", str(out)]
        calls = FailingCalls(out, fail_at, failing(kind, disk))
        code = main(["train", *how, "--in-process", *([] if begun else BUDGET)])
        (place / "calls").write_text(" ".join(calls.calls))
        return code

    return task


def problem(place: Path) -> Path:
    """The small problem with episodes as short as its model allows: the files are the same."""
    path = place / "small.yaml"
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


class Judge:
    """Lets trainings in `place` fail, and says what is wrong afterwards."""

    def __init__(self, place: Path, disk: LossyDisk | None) -> None:
        """disk: what runs are written to that lose their power."""
        self._place, self._disk = place, disk
        self._log = place / "log"
        out = place / "run"
        assert self._forked(out) == DONE, self._log.read_text()
        self._policy = (out / "policy.npz").read_bytes()
        self.calls = self._calls()
        # A training that was killed between its checkpoints, and what is called when it continues.
        self._killed = place / "killed"
        shutil.rmtree(out)
        killed_at = self.calls.index("fsync", len(self.calls) // 2)
        assert self._forked(out, killed_at, "kill") == -signal.SIGKILL
        shutil.copytree(out, self._killed)
        assert self._forked(out) == DONE, self._log.read_text()
        self.calls_continued = self._calls()

    def failures(self, kind: str) -> list[int]:
        """The numbers of the calls that can fail so."""
        if kind == "often":
            return [RESUMES]
        called = self.calls_continued if kind in CONTINUED else self.calls
        found, before = [], ""
        for n, name in enumerate(called, 1):
            if name in KINDS[kind] and (kind not in ("kill", "power") or before != "fsync"):
                found.append(n)
            before = name if name in CHANGING else before
        return found

    def judged(self, n: int, kind: str) -> str | None:
        """What is wrong after a failure at the n-th call; None if nothing is."""
        disk = self._disk if kind == "power" else None
        out = (disk.folder if disk else self._place) / "run"
        shutil.rmtree(out, ignore_errors=True)
        if kind in CONTINUED:
            shutil.copytree(self._killed, out)
        self._log.unlink(missing_ok=True)
        kills = n if kind == "often" else 0
        codes = [self._forked(out, k % len(self.calls_continued) // 2 + 1) for k in range(kills)]
        codes.append(self._forked(out, 0 if kills else n, kind, disk))
        while not (out / "result.json").exists() and len(codes) < 4:
            again = n % 7 + 1 if kind in ("kill", "power") and len(codes) == 1 else 0
            codes.append(self._forked(out, again, kind, disk))
        where = f"{kind} at call {n}, exit codes {codes[-4:]}"
        if kills and codes[:kills].count(-signal.SIGKILL) < kills:
            return f"{where}: it was killed {codes.count(-signal.SIGKILL)} times only"
        text = self._log.read_text()
        if "Traceback" in text:
            return f"{where}: a traceback: {text}"
        if not set(codes) <= {DONE, FAILED, -signal.SIGKILL} or not (out / "result.json").exists():
            return f"{where}: {text}"
        if (out / "policy.npz").read_bytes() != self._policy:
            return f"{where}: another policy"
        return None

    def _forked(
        self, out: Path, n: int = 0, kind: str = "kill", disk: LossyDisk | None = None
    ) -> int:
        code = forked(self._log, training(out, self._place, n, kind, disk))
        if disk and code == -signal.SIGKILL:
            disk.restart()
        return code

    def _calls(self) -> list[str]:
        return (self._place / "calls").read_text().split()


def run(place: Path, kinds: tuple[str, ...], most: int = 10**6) -> dict[str, Any]:
    """The failures, one after the other."""
    first_training(place)
    gc.freeze()  # what a fork touches is copied
    with contextlib.ExitStack() as stack:
        disk = LossyDisk(place / "disk") if "power" in kinds else None
        if disk:
            stack.callback(disk.close)
        judge = Judge(place, disk)
        failures = [(n, kind) for kind in kinds for n in sample(judge.failures(kind), most)]
        wrong = [sentence for n, kind in failures if (sentence := judge.judged(n, kind))]
    return {"failures": Counter(kind for _, kind in failures), "wrong": wrong}


def sample(numbers: list[int], most: int) -> list[int]:
    """As many of them, from the first to the last."""
    return numbers[:: -(-len(numbers) // most)]


def first_training(place: Path) -> None:
    """Train in this process: what each training imports and loads, those that are forked find there."""
    load_compiled(resolve(str(problem(place)), {}))
    out = place / "first"
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert (
            main(["train", str(problem(place)), "--out", str(out), "--in-process", *BUDGET]) == DONE
        )
    assert threading.active_count() == 1
    shutil.rmtree(out)


def command() -> int:
    """1 if a training did not come to the same policy."""
    possible = [kind for kind in KINDS if kind != "power" or mountable("mkfs.ext4")]
    words = argparse.ArgumentParser(prog="python -m tests.support.crash_points")
    words.add_argument("kinds", nargs="*", default=possible, metavar="KIND", help=", ".join(KINDS))
    words.add_argument(
        "--most", type=int, default=10**6, metavar="N", help="only so many calls of each kind"
    )
    given = words.parse_args()
    where = MEMORY_DISK if os.access(MEMORY_DISK, os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=where) as place:
        result = run(Path(place), tuple(given.kinds), given.most)
    print(json.dumps(result))
    return int(bool(result["wrong"]) or not result["failures"])


if __name__ == "__main__":
    sys.exit(command())
