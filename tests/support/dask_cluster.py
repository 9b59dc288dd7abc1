# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A real Dask scheduler on loopback, and real workers, whose processes a test may kill."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from tests.support.interpreter import ROOT
from tests.support.loop_harness import Forked
from tests.support.small_study import LIMIT

Process = subprocess.Popen[bytes] | Forked


class DaskCluster:
    """Processes of a scheduler and its workers, killed at the end of a test.

    Attributes
    ----------
    address : str
        Of the scheduler.
    scheduler : Popen
        Its process.
    workers : list of Popen
        Those of the workers, which are one thread each. Without packages of their own they are forked,
        as what `loop_harness` starts.
    """

    def __init__(self, folder: Path, stack: ExitStack, tls: Sequence[str] = ()) -> None:
        folder.mkdir(exist_ok=True)
        self._folder, self._stack, self._tls = folder, stack, tls
        self.workers: list[Process] = []
        self.scheduler: Process | None = None
        self.address, self._count = "", 0

    def start_scheduler(self, packages: str = str(ROOT)) -> None:
        """packages: a folder of packages that the process has instead of those here."""
        self._file.unlink(missing_ok=True)
        self.scheduler = self._started("dask_scheduler", "--port", "0", packages=packages)
        self.address = address_in(self._file)

    def start_worker(
        self, packages: str = str(ROOT), *further: str, nanny: bool = False
    ) -> Process:
        """further: options; nanny: start it again where it dies."""
        options = ("--nthreads", "1", "--local-directory", str(self._folder), *further)
        without = () if nanny else ("--no-nanny",)
        process = self._started("dask_worker", *options, *without, packages=packages)
        self.workers.append(process)
        return process

    def await_workers(self, count: int, *, exactly: bool = False) -> None:
        """Wait for at least so many workers; exactly: and until the scheduler has no other ones."""
        from distributed import Client

        with Client(self.address, set_as_default=False) as known:
            known.wait_for_workers(count, timeout=LIMIT)
            deadline = time.monotonic() + LIMIT
            while exactly and len(known.scheduler_info(n_workers=-1)["workers"]) != count:
                assert time.monotonic() < deadline, "workers that have died are still known"
                time.sleep(0.05)

    @property
    def _file(self) -> Path:
        return self._folder / "scheduler.json"

    def _started(self, command: str, *options: str, packages: str) -> Process:
        words = ["--host", "127.0.0.1", "--scheduler-file", str(self._file), "--no-dashboard"]
        words += [*self._tls, *options]
        # Of a session of its own; what it leaves when it is killed is in `folder`.
        environment = {**os.environ, "PYTHONPATH": packages, "TMPDIR": str(self._folder)}
        self._count += 1
        path = self._folder / f"{self._count}-{command}.log"
        process: Process
        if packages == str(ROOT):  # as an interpreter that has loaded what a worker does
            code = f"from distributed.cli.{command} import main; main()"
            process = Forked("-c", [code, *words], path, environment)
        else:
            log = self._stack.enter_context(path.open("ab"))
            module = (sys.executable, "-m", f"distributed.cli.{command}")
            process = subprocess.Popen(
                [*module, *words], stdout=log, stderr=log, start_new_session=True, env=environment
            )
        self._stack.callback(process.wait, LIMIT)
        self._stack.callback(_kill_session, process.pid)
        return process


def _kill_session(leader: int) -> None:
    """A nanny and its worker, or a process by itself."""
    with suppress(ProcessLookupError):
        os.killpg(leader, signal.SIGKILL)


def address_in(file: Path) -> str:
    """The scheduler's address, once it stands in its file: that is made first, and then written."""
    deadline = time.monotonic() + LIMIT
    while time.monotonic() < deadline:
        with suppress(OSError, ValueError):
            return str(json.loads(file.read_text())["address"])
        time.sleep(0.05)
    raise AssertionError("no scheduler")


@contextmanager
def dask_cluster(
    folder: Path,
    workers: int,
    *,
    scheduler: str = str(ROOT),
    worker: str = str(ROOT),
    nanny: bool = False,
) -> Iterator[DaskCluster]:
    """A scheduler with so many workers; scheduler, worker: folders of packages of theirs."""
    with ExitStack() as stack:
        cluster = DaskCluster(folder, stack)
        cluster.start_scheduler(scheduler)
        for _ in range(workers):
            cluster.start_worker(worker, nanny=nanny)
        if workers:
            cluster.await_workers(workers)
        yield cluster
