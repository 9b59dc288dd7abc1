# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Own measurements in files: read as they are documented, refused in one sentence if they are not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pdeloop
from pdeloop import data_file
from pdeloop.cli import FAILED, main
from pdeloop.data_file import read_measurements
from pdeloop.messages.model_rows import unpack
from pdeloop.method.laws import Observer
from pdeloop.method.laws.registry import along
from pdeloop.method.reduce.regression import exact_regression
from tests.support.linear_system import linear_system, trajectory
from tuner_node.build import read_model

EXAMPLE = Path(__file__).parents[2] / "examples" / "measurements.csv"
Array = np.ndarray


def arrays(**changes: Any) -> dict[str, Any]:
    states, actions = trajectory(*linear_system(4), steps=60)
    good = {"states": states, "actions": actions, "target": states[0], "sample_time": 0.1}
    return {name: value for name, value in {**good, **changes}.items() if value is not None}


def test_the_example_is_read_and_gives_the_order_of_the_plant_that_made_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = read_measurements(EXAMPLE)
    assert [(z.shape, a.shape) for z, a in found.trajectories] == [((61, 5), (60, 2))] * 2
    assert found.sample_time == 0.5 and found.target.tolist() == [1.0, 0.8, 0.5, 0.2, 0.0]
    out = tmp_path / "model.npz"
    assert main(["identify", "--data", str(EXAMPLE), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "order 5 from 120 steps of 2 trajectories" in text and "suggested" in text
    with np.load(out) as saved:
        assert np.array_equal(
            saved["A"], exact_regression(found.trajectories, n_s=5, constant=True).A
        )
    assert main(["identify", "--data", str(EXAMPLE), "--order", "2"]) == 0
    assert "order 2 from" in capsys.readouterr().out


def test_an_npz_of_one_or_several_trajectories_is_what_was_saved(tmp_path: Path) -> None:
    one = arrays()
    np.savez(tmp_path / "one.npz", **one)
    ((states, actions),) = read_measurements(tmp_path / "one.npz").trajectories
    assert np.array_equal(states, one["states"]) and np.array_equal(actions, one["actions"])
    np.savez(
        tmp_path / "two.npz", **arrays(states=[one["states"]] * 2, actions=[one["actions"]] * 2)
    )
    assert len(read_measurements(tmp_path / "two.npz").trajectories) == 2


NAN = np.full((61, 4), np.nan)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"states": None}, "states is missing; there are actions"),
        ({"states": NAN}, "finite numbers, got NaN"),
        ({"actions": np.zeros((61, 2))}, r"got shapes \(61, 4\) and \(61, 2\)"),
        ({"actions": np.zeros((60, 0))}, "of one number or more"),
        ({"target": np.zeros(3)}, "same n_z numbers"),
        ({"target": np.full(4, np.inf)}, "target of finite numbers"),
        (
            {"states": np.zeros((2, 61, 4))},
            r"K trajectories, got shapes \(2, 61, 4\) and \(60, 2\)",
        ),
        (
            {"states": np.zeros((2, 61, 4)), "actions": np.zeros((1, 60, 2))},
            r"K trajectories, got shapes \(2, 61, 4\) and \(1, 60, 2\)",
        ),
        ({"actions": np.full((60, 2), 1e200)}, r"magnitude 1e\+100 at most, got 1e\+200"),
        ({"states": np.array(["x"])}, "real numbers in states"),
        ({"states": np.array([object()])}, "holds no arrays"),
        ({"sample_time": 0.0}, "sample_time above 0"),
        ({"sample_time": np.array([1.0, 2.0])}, "one number as sample_time"),
    ],
)
def test_a_flawed_npz_is_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    path = tmp_path / "own.npz"
    np.savez(path, **arrays(**changes))
    refused(path, words)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "expected the names t, z"),
        (b"\xff\xfe\x00garbage", "expected the names t, z"),
        (b"x,y\n1,2\n", "expected the names t, z"),
        (b"t,z1,a1\n", "no trajectory of two states"),
        (b"t,z1,a1\ntarget,0,\n0,1,1\n", "no trajectory of two states"),
        (b"t,z1,a1\ntarget,0,\n0,1,1\n1,1\n", "expected 3 values in row 4, .*, got 2"),
        (b"t,z1,a1\ntarget,0,\n0,one,1\n", "expected a number, got 'one' in row 3, column z1"),
        (
            b"t,z1,a1\ntarget,0,\n0,1,1\n1,1,1\n3,1,1\n",
            "got 2 s before row 5 where the others are 1 s",
        ),
        (b"t,z1,a1\ntarget,0,\n0,1,1\nnan,1,1\n", "expected a time t in row 4"),
        (b"t,z1,a1\ntarget,0,\n0,1,\n1,1,1\n", "a1 is missing in row 3: fill the gap"),
        (b"t,z1,a1\ntarget,0,\n0,1,1\ntarget,0,\n1,1,1\n", "one row .* got a second one, row 4"),
        (b'"' + b"t," * 10**6, "it is not a table: field larger than"),
    ],
)
def test_a_flawed_csv_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "own.csv"
    path.write_bytes(content)
    refused(path, words)


def test_other_files_and_larger_ones_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused(tmp_path / "own.xlsx", r"must be a .npz, .csv, .mat or .parquet file")
    refused(tmp_path / "none.csv", "cannot be read: No such file")
    monkeypatch.setattr(data_file, "MAX_TEXT_BYTES", 100)
    refused(EXAMPLE, "larger than 100 bytes; give the same as .npz")


def test_more_trajectories_or_numbers_than_memory_may_take_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "own.npz"
    monkeypatch.setattr(data_file, "MAX_TRAJECTORIES", 2)
    np.savez(path, **arrays(states=np.zeros((3, 2, 0)), actions=np.zeros((3, 1, 0))))
    refused(path, "at most 2 trajectories, got 3")
    path = tmp_path / "own.csv"
    path.write_text("t,z1,a1\ntarget,0,\n" + "0,1,1\n" * 4)
    refused(path, "at most 2 trajectories, got 4")
    monkeypatch.setattr(data_file, "MAX_ARRAY_BYTES", 8 * 100)
    path = tmp_path / "own.npz"
    np.savez(path, **arrays(states=np.zeros((61, 4), dtype=np.int8)))
    refused(path, "at most 100 numbers, got 369")


def refused(path: Path, words: str) -> None:
    with pytest.raises(ValueError, match=words) as failed:
        read_measurements(path)
    assert "\n" not in str(failed.value) and path.name in str(failed.value)


def test_a_law_with_a_filter_is_identified_and_applied_as_it_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, words = tmp_path / "model.npz", ["identify", "--data", str(EXAMPLE)]
    assert main([*words, "--identification", "subspace", "--law", "affine"]) == FAILED
    assert "designs a filter, which the law 'affine' does not use" in capsys.readouterr().err
    filtered = ["--identification", "subspace", "--out", str(out)]
    assert main([*words, *filtered]) == 0
    assert "x = p + L (U^T z - p), and then p = A x + B a + d" in capsys.readouterr().out
    rows = read_model(out, 2, Observer)
    m = unpack(rows, 2, True)
    law = Observer(m, 60)
    (states, actions), *_ = read_measurements(EXAMPLE).trajectories
    p, expected = m.U.T @ states[0], []
    for z, a in zip(states, actions, strict=False):
        x = p + m.L @ (m.U.T @ z - p)
        expected.append(m.K_a @ x + m.K_b @ m.s_r)
        p = m.A @ x + m.B @ a + m.d
    np.testing.assert_allclose(
        along(law, law.theta_start, states[:-1], actions), expected, atol=1e-9
    )
    with pytest.raises(
        ValueError, match="has a filter gain, and the law 'affine' does not use one"
    ):
        read_model(out, 2)


def test_the_command_line_says_it_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own.csv").write_text("t,z1,a1\ntarget,0,\n0,1,1\n1,2,1\n")
    assert main(["identify", "--data", str(tmp_path / "own.csv")]) == FAILED
    assert "too few, or vary too little, to hold some of them out" in capsys.readouterr().err
    assert main(["identify", "--data", str(EXAMPLE), "--order", "9"]) == FAILED
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["identify", "--data", str(EXAMPLE), "--rank", "4"]) == FAILED
    assert "add --identification dmdc, or leave --rank out" in capsys.readouterr().err
    assert (
        main(["identify", "--data", str(EXAMPLE), "--rank", "7", "--identification", "dmdc"]) == 0
    )
    capsys.readouterr()
    np.savez(tmp_path / "idle.npz", **arrays(actions=np.zeros((60, 2))))
    assert main(["identify", "--data", str(tmp_path / "idle.npz")]) == FAILED
    assert "the inputs a1 and a2 never moved (constant at 0)" in capsys.readouterr().err
    assert main(["identify", "--data", str(EXAMPLE), "--episode", "1"]) == FAILED
    assert "choose from a bag" in capsys.readouterr().err


BAG = Path(__file__).parents[1] / "data" / "bag_0_1"


def test_episodes_under_one_law_say_nothing_of_its_inputs_and_the_exploration_does(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A recorded training: 1.1 explores, 1.3 has two policies that differ by little on one field."""
    assert main(["identify", "--bag", str(BAG)]) == 0
    assert "rank 8 of 8" in capsys.readouterr().out
    assert main(["identify", "--bag", str(BAG), "--episode", "1.3"]) == FAILED
    told = capsys.readouterr().err
    assert "always followed from the state (feedback without excitation" in told
    assert all(f"a{j}" in told for j in range(1, 5)) and told.count("\n") == 1


def test_a_bag_whose_inputs_always_moved_together_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from pdeloop.bags.episodes import RecordedEpisode

    recorded = RecordedEpisode.trajectory

    def coupled(episode: RecordedEpisode) -> tuple[Array, Array]:
        states, actions = recorded(episode)
        actions[..., 2] = -3.0 * actions[..., 0]
        return states, actions

    monkeypatch.setattr(RecordedEpisode, "trajectory", coupled)
    assert main(["identify", "--bag", str(BAG)]) == FAILED
    assert "a1 and a3 always moved together (a3 = -3 a1)" in capsys.readouterr().err


@pytest.mark.parametrize("target", [[], ["--target", "25,26,27"]])
def test_a_log_in_degrees_gives_the_model_of_the_machine(
    tmp_path: Path, target: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Two heaters of up to 5 kW, three thermocouples at 20 to 22 degC, no noise."""
    rng = np.random.default_rng(3)
    A, B, rest = (
        np.diag([0.9, 0.8, 0.5]),
        rng.uniform(0.1, 1.0, (3, 2)),
        np.array([20.0, 21.0, 22.0]),
    )
    u, x = rng.uniform(0.0, 5.0, (200, 2)), [np.zeros(3)]
    for own in u[:-1]:
        x.append(A @ x[-1] + B @ own)
    rows = np.column_stack([np.arange(200.0), np.array(x) + rest, u])
    log, out = tmp_path / "log.csv", tmp_path / "model.npz"
    np.savetxt(log, rows, delimiter=",", header="t,z1,z2,z3,a1,a2", comments="")
    how = ["--identification", "regression", "--order", "3", "--out", str(out)]
    assert main(["identify", "--data", str(log), *how, *target]) == 0
    model = pdeloop.ReducedModel.load(out)
    np.testing.assert_allclose(np.sort(model.poles.real), [0.5, 0.8, 0.9], atol=1e-9)
    settled = model.U @ np.linalg.solve(np.eye(3) - model.A, model.d)
    np.testing.assert_allclose(settled, rest, rtol=1e-9)
    assert "constant term d" in capsys.readouterr().out
    if target:  # the law ends where that of the deviations does
        gains = np.load(out)
        b = gains["K_b"] @ gains["s_r"] + gains["K_a"] @ model.U.T @ rest
        own = pdeloop.track(pdeloop.ReducedModel(A, B), state_weight=1.0, action_weight=1.0)
        np.testing.assert_allclose(b, own.K_b @ (np.array([25.0, 26.0, 27.0]) - rest), rtol=1e-6)
