# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A run has a folder to itself, which it does not leave, and a full disk spoils nothing in it."""

from __future__ import annotations

import json
import os
from contextlib import ExitStack

import pytest

from pdeloop.cli import FAILED, main
from tests.support.small import SMALL, parameters
from tuner_node import checkpoint
from tuner_node.build import build_training
from tuner_node.run_folder import RunFolder, RunFolderError
from tuner_node.run_store import open_run


@pytest.mark.parametrize(
    "name", ["../../../escaped", "a/b", "..", ".hidden", "", "x" * 101, "a\0b"]
)
def test_a_problems_name_is_no_path(tmp_path, name, capsys):
    text = SMALL.read_text().replace("problem: small", f"problem: {json.dumps(name)}")
    (tmp_path / "small.yaml").write_text(text)
    out = tmp_path / "run"
    assert (
        main(["train", str(tmp_path / "small.yaml"), "--in-process", "--out", str(out)]) == FAILED
    )
    assert "expected at most 100 letters, digits" in capsys.readouterr().err
    assert not out.exists()


def test_a_report_stays_in_its_folder(run, capsys):
    path = run / "parameters.yaml"
    path.write_text(path.read_text().replace("problem: small", "problem: ../../../escaped"))
    for command in (["evaluate", str(run)], ["report", str(run)]):
        assert main(command) == FAILED
        assert "parameter 'problem' is '../../../escaped'" in capsys.readouterr().err


def test_every_start_of_a_tuner_has_a_number_of_its_own_and_the_folder_to_itself(tmp_path):
    """Also one that is started by hand: `pdeloop train` locks the folder itself."""
    values = parameters(out=str(tmp_path / "run"), resume=False, plant_fingerprint=77)
    for incarnation in (1, 2, 3):
        with ExitStack() as locks, ExitStack() as others:
            _, identity = open_run(values, build_training(values), locks, print)
            assert identity.incarnation == incarnation
            assert json.loads((tmp_path / "run" / "run.json").read_text())["plant"] == 77
            values["resume"] = True
            with pytest.raises(RunFolderError, match="another process is working on the run"):
                open_run(values, build_training(values), others, print)


def test_a_checkpoint_that_could_not_be_written_is_written_when_it_can(tmp_path, monkeypatch):
    values, told = parameters(out=str(tmp_path / "run"), resume=False), []
    with ExitStack() as locks:
        writer, _ = open_run(values, build_training(values), locks, told.append)
        assert writer is not None
        writer.note({"event": "phase"})
        with monkeypatch.context() as full:
            full.setattr(
                checkpoint, "write_part", lambda path, *content: os.open(path, os.O_RDONLY)
            )
            writer.keep(now=0.0, force=True)
        assert "cannot write the checkpoint" in told[-1]
        assert not (tmp_path / "run" / "checkpoint").exists()
        writer.keep(now=1e6)  # nothing has happened since
        assert (tmp_path / "run" / "checkpoint").exists()


def test_a_line_after_one_that_a_full_disk_cut_off_is_whole(tmp_path):
    path = tmp_path / "progress.jsonl"
    path.write_bytes(b'{"event": "a"}\n{"event": "cut')
    RunFolder(tmp_path).note({"event": "b"})
    assert path.read_bytes() == b'{"event": "a"}\n{"event": "cut\n{"event": "b"}\n'


def test_a_folder_with_a_run_is_refused_with_what_can_be_done_with_that(finished, tmp_path, capsys):
    """A run that is complete cannot be continued: each advice is one that works."""
    words = ["train", str(SMALL), "--in-process", "--out"]
    assert main([*words, str(finished)]) == FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(f"see its results: pdeloop report {finished}")
    RunFolder(tmp_path / "begun").create(parameters())
    assert main([*words, str(tmp_path / "begun")]) == FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert f"continue it with: pdeloop train --resume {tmp_path / 'begun'}" in line
