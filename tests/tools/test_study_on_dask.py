# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Studies on a Dask cluster: the same bits, and a worker with other versions is refused."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from pdeloop.cli import main
from pdeloop.study import Study, StudyError, run
from pdeloop.study.executors import cluster
from tests.support.small_study import CONTENT, LIMIT, contents


def dask(folder: Path, command: str, *options: str, packages: str) -> subprocess.Popen[bytes]:
    """A Dask process on loopback, in a session of its own, with packages of another folder first.

    folder: for its temporary files, which it leaves when it is killed.
    """
    words = [sys.executable, "-m", "distributed.cli." + command, "--host", "127.0.0.1", *options]
    quiet, own = subprocess.DEVNULL, {"PYTHONPATH": packages, "TMPDIR": str(folder)}
    environment = {**os.environ, **own}
    return subprocess.Popen(
        words, stdout=quiet, stderr=quiet, start_new_session=True, env=environment
    )


def installed_before(name: str, folder: Path, *others: str) -> str:
    """A folder with the newest versions of packages before those installed here."""
    older = [f"{each}<{metadata.version(each)}" for each in (name, *others)]
    options = ("--quiet", "--no-deps", "--no-compile", "--only-binary=:all:", "--retries=0")
    words = [sys.executable, "-m", "pip", "install", *options, "--target", str(folder), *older]
    done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT)
    if done.returncode:
        pytest.skip(f"another {name} cannot be had: {done.stderr.strip().splitlines()[-1]}")
    return str(folder)


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
    folder: Path, workers: int, *, scheduler: str = "", worker: str = ""
) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Address of a real scheduler, and its real workers, one thread each.

    scheduler, worker: folders of packages that these processes have instead of those here.
    """
    folder.mkdir(exist_ok=True)
    file = folder / "scheduler.json"
    with ExitStack() as stack:

        def started(command: str, *options: str, packages: str) -> subprocess.Popen[bytes]:
            shared = ("--scheduler-file", str(file), "--no-dashboard")
            process = dask(folder, command, *shared, *options, packages=packages)
            stack.callback(process.wait, LIMIT)
            stack.callback(lambda: process.poll() is None and os.kill(process.pid, signal.SIGKILL))
            return process

        started("dask_scheduler", "--port", "0", packages=scheduler)
        address = address_in(file)
        known = [
            started(
                "dask_worker",
                "--no-nanny",
                "--nthreads",
                "1",
                "--local-directory",
                str(folder),
                packages=worker,
            )
            for _ in range(workers)
        ]
        if workers:
            from distributed import Client

            with Client(address, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=LIMIT)
        yield address, known


@pytest.mark.filterwarnings("default")  # of the libraries below Dask, in threads of its own
def test_a_dask_cluster_that_loses_a_worker_gives_the_same_bits(reference: Path, tmp_path: Path):
    out = tmp_path / "out"
    with dask_cluster(tmp_path, 2) as (address, workers):

        def kill_one(done: int, total: int, status: str) -> None:
            if done and workers[0].poll() is None:
                os.kill(workers[0].pid, signal.SIGKILL)

        assert run(Study.of(CONTENT), out, partial(cluster, address), tell=kill_one) == []
        assert workers[0].wait(LIMIT) == -signal.SIGKILL and workers[1].poll() is None

        def kill_the_other(done: int, total: int, status: str) -> None:
            if workers[1].poll() is None:
                os.kill(workers[1].pid, signal.SIGKILL)
            if (
                "no worker is left; waiting for one to be started: PYTHONSAFEPATH=1 dask worker tcp"
                in status
            ):
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            run(Study.of(CONTENT), tmp_path / "no", partial(cluster, address), tell=kill_the_other)
    assert contents(out) == contents(reference)


@pytest.mark.filterwarnings("default")  # of the libraries below Dask, in threads of its own
def test_a_dask_worker_with_another_numpy_is_refused_or_accepted_and_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    older = installed_before("numpy", tmp_path / "packages")
    file, out = tmp_path / "study.yaml", str(tmp_path / "out")
    file.write_text(json.dumps({**CONTENT, "seeds": 1}))
    with dask_cluster(tmp_path / "dask", 1, worker=older) as (address, _):
        words = ["study", str(file), "--out", out, "--scheduler", address]
        assert main(words) == 1
        said = capsys.readouterr().err.strip().splitlines()[-1]
        assert re.fullmatch(
            rf"pdeloop: a worker has numpy \S+ instead of {np.__version__}: .* --any-environment",
            said,
        )
        assert main([*words, "--any-environment"]) == 0
    result = json.loads((tmp_path / "out/small/two-point/0/result.json").read_text())
    numpy = result["environment"]["numpy"]
    assert numpy != np.__version__
    told = capsys.readouterr().out
    assert "two-point*" in told and f"*: some trainings had numpy {numpy} instead of" in told


@pytest.mark.filterwarnings("default")
def test_a_scheduler_and_a_worker_with_another_dask_are_refused(tmp_path: Path):
    older = installed_before("distributed", tmp_path / "packages", "dask")
    words = f"has Dask .*, and this machine has {metadata.version('distributed')}; install the same"
    study = Study.of(CONTENT)
    one = dask_cluster(tmp_path / "one", 0, scheduler=older)
    with one as (address, _), pytest.raises(StudyError, match=f"the scheduler {words}"):
        run(study, tmp_path / "out", partial(cluster, address))
    other = dask_cluster(tmp_path / "other", 1, worker=older)
    with other as (address, _), pytest.raises(StudyError, match=f"the worker at tcp://.* {words}"):
        run(study, tmp_path / "out", partial(cluster, address))


def test_a_schedulers_file_is_awaited_until_it_is_written(tmp_path: Path):
    file = tmp_path / "scheduler.json"

    def write() -> None:
        for content in ("", '{"type": "Sched', '{"address": "tcp://127.0.0.1:8786"}'):
            file.write_text(content)
            time.sleep(0.1)

    writer = threading.Thread(target=write)
    writer.start()
    assert address_in(file) == "tcp://127.0.0.1:8786"
    writer.join()
