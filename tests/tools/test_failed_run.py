# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A folder of a training that failed says why, and does not advise to continue it, which would too."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from controller_node import identification
from pdeloop.cli import main
from pdeloop.evaluation import RunFolderError
from pdeloop.finished_run import load_run
from tests.support.small import SMALL, parameters
from tests.tools.test_cli import error_of
from tuner_node.run_folder import RunFolder

REASON = "no reduced model: the plant diverged under exploration"
TRAIN = (
    "train",
    str(SMALL),
    "--in-process",
    "--optimizer",
    "two_point",
    "--iterations",
    "1",
    "--out",
)


@pytest.fixture
def failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """The folder of a training whose plant always diverges."""
    out = tmp_path / "a run"
    assert REASON in error_of(capsys, *TRAIN, str(out), "--set", "divergence_bound=0.1")
    return out


def test_every_command_that_needs_results_says_why_there_are_none(failed, tmp_path, capsys):
    run = str(failed)
    for words in (
        ["evaluate", run],
        ["report", run],
        ["animate", run],
        ["compare", run, run],
        ["export", run, "--out", str(tmp_path / "law.npz")],
        ["monitor", run],
        [*TRAIN, run],
    ):
        line = error_of(capsys, *words)
        assert REASON in line and "divergence_bound" in line and "--resume" not in line, words


def test_the_command_that_is_advised_trains(failed, tmp_path, capsys):
    (line,) = [error_of(capsys, "evaluate", str(failed))]
    advised = line.partition("a new run with other parameters: pdeloop ")[2]
    words = shlex.split(advised.replace("NAME=VALUE", "divergence_bound=1000"))
    assert main([*words, "--in-process", "--out", str(tmp_path / "other")]) == 0


def test_it_can_be_continued_to_the_same_end(failed, capsys):
    assert REASON in error_of(capsys, "train", "--resume", str(failed), "--in-process")
    assert "would fail again" in error_of(capsys, "evaluate", str(failed))


def test_data_that_allow_no_model_are_remembered_too(tmp_path, capsys, monkeypatch):
    def none(*_, **__):
        raise ValueError("the data determine no model: raise exploration_variance")

    monkeypatch.setattr(identification, "identify", none)
    out = str(tmp_path / "run")
    assert "no reduced model: the data determine no model" in error_of(capsys, *TRAIN, out)
    line = error_of(capsys, "evaluate", out)
    assert "the data determine no model: raise exploration_variance" in line


def test_a_run_with_contradicted_results_is_not_to_be_continued_either(tmp_path, capsys):
    run = RunFolder(tmp_path / "run")
    run.create(parameters())
    run.change(contradiction="two different messages")
    for task in (lambda: load_run(run.path), lambda: run.reopen(parameters())):
        with pytest.raises(RunFolderError, match=r"contradicted later \(two different") as refused:
            task()
        assert "--resume" not in str(refused.value)


def test_where_run_json_is_damaged_continuing_says_so(failed, capsys):
    (failed / "run.json").write_text(json.dumps([]))
    assert "continue it with" in error_of(capsys, "evaluate", str(failed))
    assert "run.json" in error_of(capsys, "train", "--resume", str(failed), "--in-process")
