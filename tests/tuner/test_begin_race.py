# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Who begins a training locks its folder first, looks then, and writes last."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pdeloop import domain
from pdeloop.cli import FAILED, main
from tests.support.interpreter import LIMIT, ROOT
from tests.support.small import SMALL, parameters
from tuner_node.run_folder import RunFolder, RunFolderError


def test_of_two_processes_that_begin_in_one_folder_one_does_in_any_order():
    """A sample; `.ci/run` tries every order."""
    words = (sys.executable, "-m", "tests.support.begin_race", "--every", "6")
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    ended = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True, timeout=LIMIT)
    assert ended.stdout, ended.stderr
    result = json.loads(ended.stdout)
    assert result.keys() == {"run", "create"}
    for found in result.values():
        assert found["orders"] > 12
        assert found["wrong"] == []


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL])
def test_a_file_system_without_locks_is_refused_in_a_sentence(
    tmp_path, monkeypatch, capsys, number
):
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    out = tmp_path / "run"
    assert main(["train", str(SMALL), "--in-process", "--out", str(out)]) == FAILED
    line = capsys.readouterr().err.splitlines()[-1]
    assert f"{out / 'lock'} cannot be locked ({os.strerror(number)})" in line
    assert "expected a file system with locks" in line and "choose another folder" in line
    assert not (out / "parameters.yaml").exists() and not (out / "run.json").exists()
    monkeypatch.setattr(domain, "DOMAINS_FOLDER", tmp_path / "domains")
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    with pytest.raises(domain.DomainError, match=r"cannot be locked .* set TMPDIR"):
        domain.own_domain().__enter__()


def test_a_run_that_was_completed_in_the_meantime_is_not_continued(tmp_path, monkeypatch, capsys):
    """Another process finishes it between the look and the lock."""
    folder = RunFolder(tmp_path / "run")
    folder.create({**parameters(), "rollouts": 30, "iterations": 0})
    locked = RunFolder.locked

    def finished_by_then(self: RunFolder):
        (self.path / "result.json").write_text("{}")
        return locked(self)

    monkeypatch.setattr(RunFolder, "locked", finished_by_then)
    assert main(["train", "--resume", str(folder.path), "--in-process"]) == FAILED
    assert "is complete; there is nothing to continue" in capsys.readouterr().err


def test_nothing_is_written_into_a_folder_that_another_process_has_locked(tmp_path):
    out = tmp_path / "run"
    out.mkdir()
    with RunFolder(out).locked():
        before = sorted(path.name for path in out.iterdir())
        with pytest.raises(RunFolderError, match="another process is working on the run"):
            RunFolder(out).create(parameters())
        assert sorted(path.name for path in out.iterdir()) == before
    RunFolder(out).create(parameters())
    assert Path(out / "parameters.yaml").exists()
