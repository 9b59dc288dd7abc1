# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The command line: every error is one clear line and a non-zero exit, and nothing is half-done."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest

from pdeloop.cli import main
from pdeloop.domain import DomainError, given_domain
from tests.support.small import SMALL, parameters, same_bits, train_here
from tests.support.small_disk import read_only_folder
from tuner_node import checkpoint
from tuner_node.run_folder import RunFolder


def error_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line on stderr of a command that must fail."""
    assert main(arguments) == 1
    captured = capsys.readouterr()
    # On a slow or busy machine the first use of a kernel announces its compilation.
    said = captured.err.strip().splitlines()
    (line,) = [text for text in said if not text.startswith("compiling, once")]
    assert line.startswith("pdeloop: ")
    return line


def train(out: Path, *more: str, problem: Path = SMALL) -> int:
    return main(
        ["train", str(problem), "--in-process", "--iterations", "2", "--out", str(out), *more]
    )


def test_any_parameter_can_be_set_and_is_recorded(tmp_path) -> None:
    more = ("--set", "physical.viscosity=2e-2", "--set", "horizon=20", "--set", "start=zero")
    assert train(tmp_path / "run", *more) == 0
    values = RunFolder(tmp_path / "run").values()
    assert (values["physical.viscosity"], values["horizon"], values["start"]) == (2e-2, 20, "zero")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (
            ("--set", "viscosity=1"),
            "a constant of the equation or plant is given as 'physical.viscosity'",
        ),
        (("--set", "horizn=20"), "unknown parameter 'horizn'; did you mean 'horizon'?"),
        (("--set", "horizon=many"), "'horizon' is 'many'; expected a whole number"),
        (("--set", "iterations=3"), "parameter 'iterations' is given twice; give it once"),
        (
            ("--set", "equation=own.py:Own"),
            "is code, which is not run merely because a file names it",
        ),
        (
            ("--optimizer", "model-based", "--set", "optimizer_settings.juding=2"),
            "unknown parameter 'optimizer_settings.juding' of the optimizer 'model_based'",
        ),
    ],
)
def test_what_is_set_is_checked_like_everything_else(tmp_path, capsys, more, words) -> None:
    out = str(tmp_path / "o")
    given = ("train", str(SMALL), "--in-process", "--iterations", "2", "--out", out)
    assert words in error_of(capsys, *given, *more)
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("n_z: 32", "n_z: 33", "'n_z' is 33; expected an even whole number"),
        ("integration_time: 0.005", "integration_time: 0.003", "whole multiple"),
        ("actuator_width: 0.2", "actuator_width: 0.3", "must not exceed 1"),
        ("equation: burgers", "equation: stokes", "stokes"),
        ("viscosity: 1.0e-2", "viscosity: -1.0", "viscosity"),
        ("viscosity: 1.0e-2", "density: 1.0", "unknown parameter 'physical.density'"),
        ("reduced_order: 4", "reduced_order: 400", "needs at least"),
        ("horizon: 30", "horizon: 0", "'horizon' is 0; expected"),
        ("n_a: 4", "n_aa: 4", "did you mean 'n_a'"),
        ("n_a: 4", "n_a: 4\n    actuator_positions: [0.1, 0.5]", "the n_a = 4 actuators, got 2"),
        (
            "n_a: 4",
            "n_a: 1\n    actuator_positions: [1.5]",
            "expected a list of numbers from 0 to 1",
        ),
        (
            "n_a: 4",
            "n_a: 4\n    sensors: 2\n    sensor_delays: 31",
            "sensor_delays must be at most the horizon, 30 steps, got 31",
        ),
    ],
)
def test_a_bad_problem_is_refused(tmp_path, capsys, old, new, words):
    path = tmp_path / "bad.yaml"
    assert old in SMALL.read_text()
    path.write_text(SMALL.read_text().replace(old, new))
    assert words in error_of(
        capsys, "train", str(path), "--in-process", "--out", str(tmp_path / "o")
    )
    assert not (tmp_path / "o" / "result.json").exists()


def test_unknown_problems_and_missing_arguments_say_what_is_expected(tmp_path, capsys):
    assert "unknown problem 'stokes'; expected one of" in error_of(capsys, "train", "stokes")
    assert "no problem given" in error_of(capsys, "train")
    assert "no problem file at" in error_of(capsys, "train", str(tmp_path / "no.yaml"))
    assert "--iterations is 0" in error_of(capsys, "train", "burgers", "--iterations", "0")
    assert "no run in" in error_of(capsys, "evaluate", str(tmp_path))
    assert "no run in" in error_of(capsys, "train", "--resume", str(tmp_path))
    with pytest.raises(SystemExit) as usage:
        main(["train", "burgers", "--start", "lqg"])
    assert usage.value.code == 2


def test_a_folder_that_holds_a_run_is_left_as_it_was(tmp_path, capsys):
    out = tmp_path / "run"
    assert train(out) == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    capsys.readouterr()
    line = error_of(capsys, "train", str(SMALL), "--in-process", "--out", str(out))
    assert f"{out} already holds a run" in line
    assert "is complete" in error_of(capsys, "train", "--resume", str(out))
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_a_run_that_was_killed_while_its_folder_was_made_can_be_begun_again(tmp_path, capsys):
    out = tmp_path / "run"
    assert train(out) == 0
    expected = (out / "policy.npz").read_bytes()
    for left in ([], ["run.json"]):
        for path in out.iterdir():
            if path.is_file() and path.name not in left:
                path.unlink()
        assert train(out) == 0
        assert (out / "policy.npz").read_bytes() == expected


def test_an_unwritable_folder_is_refused(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    line = error_of(capsys, "train", str(SMALL), "--out", str(tmp_path / "file" / "run"))
    assert "cannot write to" in line
    with read_only_folder(tmp_path / "disk") as folder:
        line = error_of(capsys, "train", str(SMALL), "--out", str(folder / "run"))
    # What refuses root is the disk.
    why = os.strerror(errno.EACCES if os.getuid() else errno.EROFS)
    assert line.strip().endswith(f"cannot write to {folder / 'run'}: {why}")


def test_the_result_folder_reproduces_the_run(tmp_path, capsys):
    out = tmp_path / "run"
    assert train(out, "--seeds", "2", "--start", "zero") == 0
    assert f"results in {out}" in capsys.readouterr().out
    expected = train_here(parameters(seeds=2, iterations=2, start="zero"))
    with np.load(out / "policy.npz", allow_pickle=False) as arrays:
        assert same_bits(arrays["policy"], expected.policies())
    result = json.loads((out / "result.json").read_text())
    assert len(result["history"]) == 4
    again = tmp_path / "again"
    assert main(["train", str(out / "parameters.yaml"), "--in-process", "--out", str(again)]) == 0
    assert (again / "policy.npz").read_bytes() == (out / "policy.npz").read_bytes()
    capsys.readouterr()
    assert main(["evaluate", str(out), "--json"]) == 0
    costs = json.loads(capsys.readouterr().out)
    assert costs["adapted"] == result["costs_by_field"]["adapted"]
    assert main(["evaluate", str(out), "--mean-field"]) == 0
    assert "adapted" in capsys.readouterr().out


def test_resuming_with_changed_parameters_shows_the_difference(tmp_path, capsys):
    out = tmp_path / "run"
    assert train(out) == 0
    (out / "result.json").unlink()
    text = (out / "parameters.yaml").read_text()
    assert main(["train", "--resume", str(out), "--in-process"]) == 0
    (out / "result.json").unlink()
    (out / "parameters.yaml").write_text(text.replace("seed: 0", "seed: 5", 1))
    line = error_of(capsys, "train", "--resume", str(out), "--in-process")
    assert "has other parameters (seed: 0 there, 5 now)" in line


def test_a_run_of_a_version_with_fewer_parameters_can_be_resumed(tmp_path, capsys):
    out = tmp_path / "run"
    assert train(out) == 0
    policy = (out / "policy.npz").read_bytes()
    (out / "result.json").unlink()
    text = (out / "parameters.yaml").read_text()
    lines = [line for line in text.splitlines() if "measurement_noise" not in line]
    (out / "parameters.yaml").write_text("\n".join(lines) + "\n")
    known = json.loads((out / "run.json").read_text())
    assert known["parameters"].pop("measurement_noise") == 0.0
    (out / "run.json").write_text(json.dumps(known))
    assert main(["train", "--resume", str(out), "--in-process"]) == 0
    assert (out / "policy.npz").read_bytes() == policy
    (out / "result.json").unlink()
    (out / "parameters.yaml").write_text(
        text.replace("measurement_noise: 0.0", "measurement_noise: 0.5")
    )
    (out / "run.json").write_text(json.dumps(known))
    line = error_of(capsys, "train", "--resume", str(out), "--in-process")
    assert "has other parameters (measurement_noise: 0.0 there, 0.5 now)" in line


def test_a_run_without_a_usable_checkpoint_begins_again_and_comes_to_the_same_policy(
    tmp_path, capsys
):
    out = tmp_path / "run"
    assert train(out) == 0
    policy = (out / "policy.npz").read_bytes()
    (out / "result.json").unlink()
    for path in (out / "checkpoint", checkpoint.previous(out / "checkpoint")):
        path.write_bytes(path.read_bytes()[:-20])
    (out / "policy.npz").write_bytes(b"PK\3\4nonsense")
    capsys.readouterr()
    assert "policy.npz cannot be read" in error_of(capsys, "evaluate", str(out))
    assert main(["train", "--resume", str(out), "--in-process"]) == 0
    text = capsys.readouterr().out
    assert text.count("its checksum does not match; beginning again from the start") == 2
    assert (out / "policy.npz").read_bytes() == policy


def test_a_truncated_checkpoint_falls_back_to_the_one_before(tmp_path, capsys):
    out = tmp_path / "run"
    assert train(out) == 0
    policy = (out / "policy.npz").read_bytes()
    (out / "result.json").unlink()
    path = out / "checkpoint"
    path.write_bytes(path.read_bytes()[:-7])
    assert main(["train", "--resume", str(out), "--in-process"]) == 0
    text = capsys.readouterr().out
    assert "is damaged: its checksum does not match; using an older checkpoint" in text
    assert (out / "policy.npz").read_bytes() == policy


def test_a_checkpoint_of_another_run_is_not_taken(tmp_path, capsys):
    for name in ("a", "b"):
        assert train(tmp_path / name, "--seed", str("ab".index(name))) == 0
        (tmp_path / name / "result.json").unlink()
    policy = (tmp_path / "b" / "policy.npz").read_bytes()
    for file in ("checkpoint", "checkpoint.previous"):
        source = tmp_path / "a" / file
        (tmp_path / "b" / file).write_bytes(source.read_bytes())
    capsys.readouterr()
    assert main(["train", "--resume", str(tmp_path / "b"), "--in-process"]) == 0
    text = capsys.readouterr().out
    assert text.count("belongs to another run; beginning again from the start") == 2
    assert (tmp_path / "b" / "policy.npz").read_bytes() == policy


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["train", "burgers", "--out", ""], "argument --out: it is empty; expected a path"),
        (["report", "run", "--out", ""], "argument --out: it is empty"),
        (["check", "burgers", "--picture", ""], "argument --picture: it is empty"),
        (["train", "burgers", "--out", os.fsdecode(b"a\xff")], "'a\\udcff' is not valid UTF-8"),
    ],
)
def test_what_is_no_path_is_not_understood(capsys, words, said):
    with pytest.raises(SystemExit) as usage:
        main(words)
    assert usage.value.code == 2
    assert said in capsys.readouterr().err


def test_a_domain_is_written_in_ordinary_digits(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "²")
    with pytest.raises(DomainError, match="expected a whole number from 0 to 232"):
        given_domain()


def test_an_equation_that_is_not_the_runs_is_refused(tmp_path, capsys):
    out = tmp_path / "run"
    assert train(out) == 0
    capsys.readouterr()
    for command in (["evaluate", str(out)], ["report", str(out)]):
        assert "--equation is kdv, but that of the run is burgers" in error_of(
            capsys, *command, "--equation", "kdv"
        )
    assert not (out / "report").exists()
    assert main(["evaluate", str(out), "--equation", "burgers"]) == 0
    (out / "result.json").unlink()
    words = ("train", "--resume", str(out), "--in-process", "--equation", "kdv")
    assert "--equation is kdv" in error_of(capsys, *words)


def test_a_folder_in_the_place_of_a_file_is_left_as_it_was(tmp_path, capsys):
    (tmp_path / "there").mkdir()
    path, data = str(tmp_path / "there"), "examples/measurements.csv"
    assert "Is a directory" in error_of(capsys, "identify", "--data", data, "--out", path)
    assert "Is a directory" in error_of(capsys, "check", str(SMALL), "--picture", path)
    assert list(tmp_path.rglob("*")) == [tmp_path / "there"]


def test_a_folder_that_another_process_works_on_is_left_alone(tmp_path, capsys):
    out = tmp_path / "run"
    assert train(out) == 0
    (out / "result.json").unlink()
    with RunFolder(out).locked():
        line = error_of(capsys, "train", "--resume", str(out), "--in-process")
    assert "another process is working on the run" in line


def test_a_file_that_expands_without_end_is_refused(tmp_path, capsys):
    levels = ["a0: &a0 {x: 1}"] + [
        f"a{i}: &a{i} {{{', '.join(f'k{j}: *a{i - 1}' for j in range(10))}}}" for i in range(1, 12)
    ]
    text = "/**:\n  ros__parameters:\n" + "".join(f"    {line}\n" for line in levels)
    (tmp_path / "bomb.yaml").write_text(text)
    assert "repeats 'a0' by an alias" in error_of(capsys, "train", str(tmp_path / "bomb.yaml"))
    text = "/**:\n  ros__parameters:\n" + "".join(f"    a{i}: 1\n" for i in range(10_001))
    (tmp_path / "many.yaml").write_text(text)
    assert "more than 10000 parameters" in error_of(capsys, "train", str(tmp_path / "many.yaml"))


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["train", str(SMALL), "--horizon", "2"], "train"),
        (["new", "my", "pde"], "new"),
        (["bag", "verify", "a", "--bogus"], "bag verify"),
        (["monitor", "b", "c"], "monitor"),
    ],
)
def test_words_that_are_not_known_name_the_commands_help(capsys, words, command):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    usage, *_, told = capsys.readouterr().err.splitlines()
    assert usage.startswith(f"usage: pdeloop {command} ")
    assert told.startswith(f"pdeloop {command}: error: unrecognized arguments: ")
    assert told.endswith(f"see `pdeloop {command} --help`")


def test_an_error_names_the_flag(capsys, tmp_path):
    line = error_of(capsys, "evaluate", str(tmp_path), "--fields", "0")
    assert line == "pdeloop: --fields is 0; expected a whole number from 1 to 1000"
