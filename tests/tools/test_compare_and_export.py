# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Runs beside each other, and a law in other programs: the same numbers as in the loop."""

from __future__ import annotations

import csv
import ctypes
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller_node.law_batch import LawBatch
from controller_node.policy import ProjectedLaw
from pdeloop.cli import FAILED, main
from pdeloop.comparison import compare
from pdeloop.export import GainLaw, Parameters, curve_csv
from pdeloop.finished_run import load_run
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.model_rows import ModelRows
from pdeloop.messages.spec import ParameterError
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.study.table import reduction_texts
from tests.support.small import SMALL

LIMIT = 0.2
DOUBLES = ctypes.POINTER(ctypes.c_double)
needs_compiler = pytest.mark.skipif(
    shutil.which("cc") is None, reason="needs a C compiler, the command cc (make packages)"
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("runs")
    kinds = {
        "plain": ("--seeds", "2", "--seed", "5"),
        "other": ("--set", "learning_rate=0.001"),
        "thick": ("--set", "physical.viscosity=0.05"),
        "limited": ("--action-limit", str(LIMIT)),
    }
    for name, words in kinds.items():
        quick = ("--in-process", "--iterations", "2", "--out", str(folder / name))
        assert main(["train", str(SMALL), *quick, *words]) == 0
    return {name: folder / name for name in kinds}


def test_runs_are_compared_on_the_same_fields(
    runs: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    plain, other = (load_run(runs[name]) for name in ("plain", "other"))
    capsys.readouterr()
    assert main(["compare", str(plain.folder), str(other.folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    first, second = found["rows"]
    assert found["apart"] == [] and found["differing"]["learning_rate"] == [1e-4, 1e-3]
    assert first["above_first"] is None and first["seeds"] == 2
    for row, run in ((first, plain), (second, other)):
        for name, costs in run.costs.items():
            assert row["costs"][name] == pytest.approx(costs.mean(), rel=1e-12)
    expected = other.costs["adapted"].mean() / plain.costs["adapted"].mean() - 1
    assert second["above_first"]["percent"] == pytest.approx(100 * expected, rel=1e-9, abs=1e-9)
    low, high = second["above_first"]["interval"]
    assert low <= second["above_first"]["percent"] <= high
    assert main(["compare", str(plain.folder), str(other.folder)]) == 0
    assert "learning_rate" in capsys.readouterr().out


def test_settings_that_only_one_of_two_methods_has_are_not_listed(runs: dict[str, Path]) -> None:
    plain = load_run(runs["plain"])
    own = {"optimizer_settings.radius": 0.1, "optimizer": "other"}
    text = compare([plain, replace(plain, values={**plain.values, **own})]).text()
    assert "optimizer " in text and "optimizer_settings.radius" not in text
    del own["optimizer"]
    text = compare([plain, replace(plain, values={**plain.values, **own})]).text()
    assert "optimizer_settings.radius" in text


def test_a_run_against_itself_is_no_percent_above(runs: dict[str, Path]) -> None:
    run = load_run(runs["plain"])
    found = compare([run, run])
    assert found.differing == {}
    assert found.rows()[1]["above_first"] == {"percent": 0.0, "interval": [0.0, 0.0]}


def test_a_share_that_rounds_to_zero_has_no_minus_sign(runs: dict[str, Path]) -> None:
    run = load_run(runs["plain"])
    adapted = run.costs["adapted"]
    lower = replace(run, costs={**run.costs, "adapted": 0.9999 * adapted, "lqt": 0.9998 * adapted})
    text = compare([run, lower]).text()
    assert "0.0 %" in text.splitlines()[2] and "-0.0" not in text
    found = {"ratio_of_means": -0.01, "ratio_interval": (-0.04, 0.01), "mean_of_ratios": -0.02}
    assert reduction_texts({**found, "mean_interval": None}) == ("0.0 (0.0 to 0.0)", "0.0")


def test_costs_of_another_plant_are_not_compared(
    runs: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    two = ["compare", str(runs["plain"]), str(runs["thick"])]
    for words in ([], ["--json"]):
        assert main([*two, *words]) == FAILED
        told = capsys.readouterr()
        assert "the costs cannot be compared: the runs differ in physical.viscosity" in told.err
        assert told.err.count("\n") == 1 and str(runs["thick"]) in told.out
    assert compare([load_run(runs[n]) for n in ("plain", "thick")]).rows()[1]["above_first"] is None


def test_what_is_no_run_is_refused(
    runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", str(runs["plain"]), str(tmp_path)]) == FAILED
    assert "no run in" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["compare", str(runs["plain"])])
    assert "expected two runs or more" in capsys.readouterr().err


def compiled(source: Path) -> Any:
    """The function of an exported law, compiled without a warning."""
    library = source.with_suffix(".so")
    strict = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC")
    built = subprocess.run(
        ["cc", *strict, "-o", str(library), str(source)], capture_output=True, text=True, timeout=60
    )
    assert built.returncode == 0, built.stderr
    return ctypes.CDLL(str(library)).pdeloop_law


@needs_compiler
@pytest.mark.parametrize(("name", "law", "seed"), [("plain", "adapted", 6), ("limited", "lqt", 0)])
def test_the_law_in_c_is_the_law_of_the_loop(
    runs: dict[str, Path], tmp_path: Path, name: str, law: str, seed: int
) -> None:
    run, source = load_run(runs[name]), tmp_path / "law.c"
    words = ["--out", str(source), "--controller", law, "--seed", str(seed)]
    assert main(["export", str(runs[name]), *words]) == 0
    function = compiled(source)
    m = run.seeds.index(seed)
    model, gains = run.models[m], (run.policies if law == "adapted" else run.warm)[m]
    states = np.random.default_rng(0).normal(size=(20, len(model.U)))
    limit = run.values["action_limit"]
    n_s = model.U.shape[1]
    expected = states @ model.U @ gains[:, :n_s].T + gains[:, n_s:] @ model.s_r
    found = np.empty((20, len(gains)))
    for z, a in zip(states, found, strict=True):
        function(z.ctypes.data_as(DOUBLES), a.ctypes.data_as(DOUBLES))
    if limit:
        assert (np.abs(expected) > limit).any()
        expected = np.clip(expected, -limit, limit)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)
    loop = ProjectedLaw([model.U], np.linalg.pinv(model.U.T) @ model.s_r, ActionSet(limit=limit))
    loop.set(np.repeat(gains[np.newaxis], 20, axis=0), np.zeros(20, dtype=np.int64))
    np.testing.assert_allclose(found, loop.actions(states), rtol=1e-12, atol=1e-13)


@needs_compiler
def test_a_law_with_a_linear_filter_in_c_is_that_of_the_loop(tmp_path: Path) -> None:
    out, source, horizon = tmp_path / "run", tmp_path / "law.c", 20
    words = ["--sensors", "8", "--law", "observer", "--optimizer", "two-point", "--iterations", "2"]
    words += ["--action-limit", str(LIMIT), "--set", f"horizon={horizon}", "--out", str(out)]
    assert main(["train", str(SMALL), "--in-process", *words]) == 0
    run = load_run(out)
    assert main(["export", str(out), "--out", str(source)]) == 0
    assert_c_is(source, run.laws[0], run.policies[0])

    # So is one with a nonlinear filter as long as it acts on its linear one alone.
    law = ExtendedKalman(run.models[0], horizon)
    theta = law.theta_start.ravel()
    exported = Parameters(
        law.name, theta, law.model, law, ActionSet(limit=LIMIT), 0.1, "the lqt law"
    )
    source = tmp_path / "first.c"  # a library that is loaded already is not loaded again
    source.write_bytes(exported.c())
    assert_c_is(source, law, theta)
    with pytest.raises(ParameterError, match="train with `--law observer`, which can"):
        replace(exported, theta=np.ones_like(theta)).c()


def assert_c_is(source: Path, law: Any, theta: Any) -> None:
    """Assert that an exported law gives the actions of the loop's, in two episodes."""
    function, loop, found = (
        compiled(source),
        LawBatch([law], np.zeros(8), ActionSet(limit=LIMIT)),
        np.empty(law.n_a),
    )
    readings = np.random.default_rng(0).normal(size=(law.horizon, 8))
    for _ in range(2):
        memory = ctypes.create_string_buffer(8 * (1 + len(law.model.A)))
        loop.set(theta.reshape(1, *law.shape))
        for k, y in enumerate(readings):
            function(memory, y.ctypes.data_as(DOUBLES), found.ctypes.data_as(DOUBLES))
            np.testing.assert_allclose(found, loop.actions(k, y[None])[0], rtol=1e-9, atol=1e-12)


def test_the_law_in_an_npz_begins_a_training(runs: dict[str, Path], tmp_path: Path) -> None:
    out, again = tmp_path / "law.npz", tmp_path / "again"
    assert main(["export", str(runs["plain"]), "--out", str(out)]) == 0
    run = load_run(runs["plain"])
    with np.load(out) as law:
        assert np.array_equal(np.hstack([law["K_a"], law["K_b"]]), run.policies[0])
    words = ["--in-process", "--iterations", "1", "--model", str(out), "--out", str(again)]
    assert main(["train", str(SMALL), *words]) == 0
    assert np.array_equal(load_run(again).warm[0], run.policies[0])


def test_the_former_name_of_a_flag_is_understood(
    runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """--law is the kind of a law elsewhere."""
    files = {}
    for flag in ("--controller", "--law"):
        files[flag] = tmp_path / f"{flag[2:]}.npz"
        assert main(["export", str(runs["plain"]), "--out", str(files[flag]), flag, "lqt"]) == 0
        assert ("now called --controller" in capsys.readouterr().err) == (flag == "--law")
    old, new = (np.load(path) for path in files.values())
    assert np.array_equal(old["K_a"], new["K_a"])


def test_texts_of_a_file_become_neither_a_formula_nor_the_end_of_a_comment() -> None:
    row = {"event": "adapted", "seed": 0, "rollouts": 3, "cost": -1.5, "role": '=HYPERLINK("x")'}
    run: Any = SimpleNamespace(result={"history": [row]})
    (_, line) = curve_csv(run).decode().splitlines()
    (cells,) = csv.reader([line])
    assert cells[2:4] == ["-1.5", '\'=HYPERLINK("x")']
    own = ModelRows(
        **{name: np.ones((1, 1)) for name in ("A", "B", "U", "K_a", "K_b")}, s_r=np.ones(1)
    )
    code = GainLaw(own, ActionSet(), 0.1, "a **// system(0); /*").c().decode()
    assert code.index("*/") == code.index(" */\n") + 1


def test_the_curve_is_that_of_the_history(
    runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "curve.csv"
    assert main(["export", str(runs["plain"]), "--curve", str(path)]) == 0
    assert capsys.readouterr().out == f"written to {path}\n"
    with path.open() as file:
        rows = list(csv.DictReader(file))
    history = load_run(runs["plain"]).result["history"]
    steps = [row for row in history if row["event"] == "adapted"]
    assert len(rows) == len(steps) > 2
    for row, step in zip(rows, steps, strict=True):
        assert int(row["seed"]) == step["seed"] and int(row["rollouts"]) == step["rollouts"]
        assert row["cost"] == ("" if step.get("cost") is None else repr(step["cost"]))


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["--out", "law.onnx"], FAILED, "a file that ends in .npz or .c"),
        (["--curve", "curve.txt"], FAILED, "a file that ends in .csv"),
        (["--out", "law.npz", "--seed", "9"], FAILED, "no seed 9; expected one from 5 to 6"),
        (["--out", "none/law.c"], FAILED, "cannot write none/law.c: No such file"),
        ([], 2, "expected --out FILE"),
        (["--curve", "c.csv", "--seed", "5"], 2, "--controller and --seed choose a law"),
    ],
)
def test_what_cannot_be_exported_is_refused(
    runs: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    code: int,
    told: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        ended: object = main(["export", str(runs["plain"]), *words])
    except SystemExit as end:
        ended = end.code
    assert ended == code and told in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
