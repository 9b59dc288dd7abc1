# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop identify --data` of inputs that are logged late, or act late."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from pdeloop.cli import main
from pdeloop.messages.model_rows import ModelRows
from tests.method.test_input_delay import A, B, K, cost_with_delay, logged
from tests.tools.test_cli import error_of

START = np.array([1.0, -1.0, 2.0, 0.5])


def written(path: Path, z: np.ndarray, a: np.ndarray) -> str:
    np.savez(path, states=z, actions=a, target=np.zeros(4), sample_time=0.1)
    return str(path)


def identified(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[dict[str, Any], str]:
    assert main(["identify", *words, "--order", "4", "--action-weight", "0.01", "--json"]) == 0
    said = capsys.readouterr()
    return json.loads(said.out), said.err


def test_a_late_log_gives_the_plant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    z, a = logged((0, 0), noise=0.0)
    data = written(tmp_path / "late.npz", z[1:-1], a[:-2])  # a_k beside the state that it led to
    found, said = identified(capsys, "--data", data)
    assert "times better with the inputs one row earlier" in said
    assert "--input-delay=-1" in said and found["input_delay"] == [0, 0]
    model = tmp_path / "model.npz"
    for delay in ("auto", "-1"):
        found, said = identified(
            capsys, "--data", data, f"--input-delay={delay}", "--out", str(model)
        )
        assert "row" not in said and found["input_delay"] == [-1, -1]
        arrays = np.load(model)
        np.testing.assert_allclose(arrays["U"] @ arrays["B"], B, atol=1e-6)
        assert "L" not in arrays  # a law without a memory


@pytest.mark.parametrize("identification", ["regression", "subspace"])
def test_a_dead_time_gets_the_law_of_the_delayed_plant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], identification: str
) -> None:
    data = written(tmp_path / "dead.npz", *logged((3, 3), noise=1e-7))
    model, method = tmp_path / "model.npz", ("--identification", identification)
    found, said = identified(
        capsys, "--data", data, "--input-delay", "auto", *method, "--out", str(model)
    )
    assert found["input_delay"] == [3, 3] and found["reduced_order"] == 4 + 3 * 2
    arrays = np.load(model)
    names = ("A", "B", "U", "K_a", "K_b", "s_r", "L")
    cost, _ = cost_with_delay(ModelRows(**{name: arrays[name] for name in names}), 3, START)
    P = linalg.solve_discrete_are(A, B, np.eye(4), 0.01 * np.eye(2))
    free = [np.linalg.matrix_power(A, i) @ START for i in range(4)]
    least = sum(float(z @ z) for z in free[:3]) + float(free[3] @ P @ free[3])
    assert cost == pytest.approx(least, rel=1e-3)
    # Without the option it is only said.
    plain, said = identified(capsys, "--data", data, *method)
    assert (
        "3 rows later" in said and "dead time of 0.3 s" in said and plain["input_delay"] == [0, 0]
    )


def test_data_without_a_target_give_the_model_with_its_last_inputs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, model = tmp_path / "dead.npz", tmp_path / "model.npz"
    z, a = logged((0, 2), noise=0.0)
    np.savez(path, states=z, actions=a, sample_time=0.1)
    assert main(["identify", "--data", str(path), "--input-delay", "0,2", "--out", str(model)]) == 0
    assert "input delay of 0 and 2 steps" in capsys.readouterr().out
    arrays = np.load(model)
    poles = np.sort(np.abs(np.linalg.eigvals(arrays["A"])))
    np.testing.assert_allclose(poles[2:], np.sort(np.linalg.eigvals(A)), atol=1e-6)
    np.testing.assert_allclose(poles[:2], 0.0, atol=1e-6)


def test_feedback_is_not_taken_for_a_late_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = written(tmp_path / "fed.npz", *logged((0, 0), process=1.0, feedback=1.0))
    assert (
        K.any()
        and "times better"
        not in identified(capsys, "--data", data, "--identification", "regression")[1]
    )


@pytest.mark.parametrize(
    ("delay", "told"),
    [("1,2,3", "one for each of the 2 inputs, got 3"), ("99", "no trajectory has more steps")],
)
def test_a_wrong_delay_is_answered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], delay: str, told: str
) -> None:
    data = written(tmp_path / "short.npz", *logged((0, 0), steps=80))
    assert told in error_of(capsys, "identify", "--data", data, "--input-delay", delay)


def test_a_delay_is_a_whole_number(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["identify", "--data", "any.npz", "--input-delay", "soon"])
    assert "expected auto, or whole numbers" in capsys.readouterr().err
