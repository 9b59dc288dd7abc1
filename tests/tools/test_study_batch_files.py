# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The batch files of docs/scaling.md: their commands, carried out here in processes that are killed."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import pytest
import yaml

from pdeloop.study import Study, run
from pdeloop.study.cluster import cluster
from pdeloop.study.table import status
from tests.support.dask_cluster import dask_cluster
from tests.support.interpreter import ROOT
from tests.support.loop_harness import until
from tests.support.small_study import CONTENT, LIMIT, contents

PAGE = (ROOT / "docs/scaling.md").read_text()
SLURM, KUBERNETES = (
    next(text for text in re.findall(rf"```{kind}\n(.*?)```", PAGE, re.DOTALL) if word in text)
    for kind, word in (("sh", "#SBATCH"), ("yaml", "kind: Job"))
)
ENVIRONMENT = {
    **os.environ,
    "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    "PYTHONPATH": str(ROOT),
}
SRUN = """#!/bin/sh
# As Slurm's: the command once for each task, of which there are two here.
"$@" & "$@" & wait
"""


def has_begun(out: Path) -> bool:
    return any(out.rglob("progress.jsonl"))


def workers_of(session: int) -> list[int]:
    """The processes of a session that train: below a nanny each."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            fields = (path / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == session and b"spawn_main" in (path / "cmdline").read_bytes():
                found.append(int(path.name))
    return found


def end(process: subprocess.Popen[bytes]) -> None:
    """As a batch system that ends a job: all its processes."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait(LIMIT)


def test_a_slurm_job_that_loses_workers_and_its_time_is_submitted_again(
    reference: Path, tmp_path: Path
):
    for name, text in (("srun", SRUN), ("job", SLURM)):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    (tmp_path / "study.yaml").write_text(json.dumps(CONTENT))
    own = {"INTERFACE": "lo", "STUDY": "study.yaml", "OUT": "out", "TMPDIR": str(tmp_path)}
    environment = {**ENVIRONMENT, **own, "PATH": f"{tmp_path}:{ENVIRONMENT['PATH']}"}
    out = tmp_path / "out"

    def submitted() -> subprocess.Popen[bytes]:
        with (tmp_path / "log").open("ab") as log:
            return subprocess.Popen(
                ["./job"],
                cwd=tmp_path,
                env=environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    job = submitted()
    try:
        until(lambda: has_begun(out), LIMIT, "training that has begun")
        for worker in workers_of(job.pid):
            os.kill(worker, signal.SIGKILL)
        until(lambda: status(out)["finished"] > 0, LIMIT, "result")
    finally:
        end(job)
    until(lambda: not status(out)["running"], LIMIT, "end of the driver")
    assert status(out)["workers_lost"] > 0
    job = submitted()
    try:
        assert job.wait(LIMIT) == 0, (tmp_path / "log").read_text()
    finally:
        end(job)
    assert contents(out) == contents(reference)


@pytest.mark.filterwarnings("default")  # of the libraries below Dask, in threads of its own
def test_a_kubernetes_job_starts_its_workers_again_and_is_complete(reference: Path, tmp_path: Path):
    job = yaml.safe_load(KUBERNETES)["spec"]
    pod = job["template"]["spec"]
    assert pod["restartPolicy"] == "OnFailure"
    (container,) = pod["containers"]
    environment = ENVIRONMENT | {one["name"]: one["value"] for one in container["env"]}
    environment["TMPDIR"] = str(tmp_path)
    ends: list[int] = []
    running: list[subprocess.Popen[bytes]] = []

    def kept_running(command: list[str]) -> None:
        """As a kubelet does, with one container."""
        with (tmp_path / "log").open("ab") as log:
            while not ends or (ends[-1] and len(ends) < 5):
                process = subprocess.Popen(
                    command, env=environment, stdout=log, stderr=log, start_new_session=True
                )
                running.append(process)
                ends.append(process.wait(LIMIT))

    out = tmp_path / "out"
    with dask_cluster(tmp_path / "dask", 0) as dask:
        address = {"tcp://scheduler:8786": dask.address}
        command = [address.get(word, word) for word in container["command"]]
        kubelet = threading.Thread(target=kept_running, args=(command,))
        kubelet.start()

        def kill_one(done: int, total: int, told: str) -> None:
            if not ends and has_begun(out):
                end(running[0])

        try:
            assert run(Study.of(CONTENT), out, lambda: cluster(dask.address), tell=kill_one) == []
            assert dask.scheduler is not None
            dask.scheduler.send_signal(
                signal.SIGTERM
            )  # as the pod of the scheduler, when the study is finished
            kubelet.join(LIMIT)
        finally:
            ends.append(0)
            end(running[-1])
            kubelet.join(LIMIT)
    assert ends[:2] == [-signal.SIGKILL, 0], (tmp_path / "log").read_text()
    assert contents(out) == contents(reference)
