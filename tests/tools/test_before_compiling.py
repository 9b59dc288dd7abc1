# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What can be refused without a compiler is refused before anything is compiled."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from pdeloop.cli import main
from pdeloop.jit.native import MachineCode
from tests.support.small import SMALL

TRAIN = ("train", str(SMALL))


@pytest.fixture(autouse=True)
def _no_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In an empty folder, where machine code can be neither loaded nor compiled."""

    def refuse(code: MachineCode) -> int:
        raise AssertionError("something is compiled")

    monkeypatch.setattr(MachineCode, "__call__", refuse)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "parameters.yaml").write_text("")
    (tmp_path / "file").write_text("")
    (tmp_path / "study.yaml").write_text(
        f"{{problems: [{SMALL}], variants: {{good: {{}}, bad: {{n_a: 0}}}}}}"
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("train", "stokes"), "unknown problem 'stokes'"),
        ((*TRAIN, "--rollouts", "3"), "'rollouts' is 3; expected at least 5"),
        ((*TRAIN, "--optimizer", "model-based", "--iterations", "3"), "does not count iterations"),
        ((*TRAIN, "--reduced-order", "0", "--seeds", "2"), "give --reduced-order N"),
        ((*TRAIN, "--reduced-order", "33"), "needs at least 36 steps, but there are 30"),
        ((*TRAIN, "--reduced-order", "30", "--identification", "dmdc"), "p must be at most"),
        ((*TRAIN, "--sensors", "64"), "sensors must be at most the 32 grid points"),
        ((*TRAIN, "--sensors", "4", "--sensor-delays", "31"), "sensor_delays must be at most"),
        ((*TRAIN, "--sensor-delays", "2"), "--sensor-delays needs --sensors"),
        ((*TRAIN, "--actuator-positions", "0.5"), "actuator"),
        ((*TRAIN, "--model", "nowhere.npz"), "nowhere.npz"),
        ((*TRAIN, "--model", "file"), "holds no arrays"),
        ((*TRAIN, "--out", "taken"), "already holds a run"),
        ((*TRAIN, "--out", "file"), "file is not a folder"),
        ((*TRAIN, "--out", "file/below"), "file is not a folder"),
        ((*TRAIN, "--pairs", "65"), "'pairs' is 65"),
        ((*TRAIN, "--in-process", "--record"), "leave out --in-process"),
        ((*TRAIN, "--equation", "stokes"), "unknown equation 'stokes'"),
        ((*TRAIN, "--equation", "nowhere.py:Own"), "does not exist"),
        (("reproduce", str(SMALL), "--iterations", "1"), "expected at least 6"),
        (("check", str(SMALL), "--equation", "stokes"), "unknown equation"),
        (("check", "nowhere.yaml"), "no problem file"),
        (("study", "study.yaml"), "small, variant 'bad': parameter 'n_a' is 0"),
    ],
)
def test_a_mistake_is_refused_first(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    before = sorted(tmp_path.rglob("*"))
    try:
        assert main(words) == 1
    except SystemExit as usage:
        assert usage.code == 2
    assert said in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_a_wrong_ros_domain_is_refused_first(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "lab")
    assert main(TRAIN) == 1
    assert "ROS_DOMAIN_ID is 'lab'; expected a whole number" in capsys.readouterr().err


def test_a_machine_without_ros_is_told_what_to_do_first(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: None if n == "rclpy" else find(n))
    assert main(TRAIN) == 1
    said = capsys.readouterr().err
    assert "pip install 'pdeloop[ros]'" in said and "--in-process" in said
    assert not (tmp_path / "runs").exists()
