# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What checks something does not pass on nothing.

| check | on nothing | tested |
|---|---|---|
| `pdeloop bag verify` | code 1, "nothing was recomputed" | tests/recorder/test_bag_verify.py |
| `pdeloop check FILE` or node | code 1 without a finding | here |
| `pdeloop identify --validate FILE` | refused without a step | here |
| residuals, stability and FIT of `identify` | not called white, stable or exact | here |
| `pdeloop study status DIR` | refused without a study; 0 of N without a training | here |
| `pdeloop compare` | refused below two runs | here |
| `pdeloop evaluate`, closing evaluations | refused without fields | here |
| simulated seeds, mutants, planted bugs | code 1 without one | here |
| repository rules over files | fail where a pattern finds no file | tests/house/test_tests.py |
| parametrised tests | fail at collection without a case | pyproject.toml, here |
| `make findings` | reported as changed without a script | here |
"""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import pdeloop
from pdeloop.cli import main
from pdeloop.model_checks import fit_percent, largest_pole, residuals, stability
from tests.simulation import __main__ as simulation
from tests.simulation import mutants, planted
from tests.support.interpreter import ROOT
from tests.tools.test_cli import error_of
from tests.tools.test_model_checks import plant, regressed


def test_a_check_without_findings_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pdeloop.problem_check.check", lambda values: iter(()))
    assert main(["check", "burgers"]) == 1


def test_a_file_without_a_step_validates_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    z, a = plant(0.8)
    rows = [f"{0.1 * k},{z[k, 0]},{z[k, 1]},{a[min(k, 299), 0]}" for k in range(len(z))]
    for name, lines in {"log": rows, "empty": [], "single": rows[:1]}.items():
        (tmp_path / f"{name}.csv").write_text("\n".join(["t,x1,x2,u1", *lines]) + "\n")
    words = ["identify", "--data", str(tmp_path / "log.csv"), "--states", "x1,x2", "--inputs", "u1"]
    assert main([*words, "--validate", str(tmp_path / "log.csv")]) == 0
    capsys.readouterr()
    for name in ("empty", "single"):
        file = str(tmp_path / f"{name}.csv")
        assert file in error_of(capsys, *words, "--validate", file)


def test_too_few_steps_are_not_called_white_stable_or_exact() -> None:
    model = regressed([plant(0.8)])
    for steps in (1, 15):
        few = plant(0.8, steps=steps)
        assert residuals(model, [few]).summary()["white"] is None
    some = residuals(model, [plant(0.8, steps=40)])
    assert some.count and "too few for a test against earlier inputs" in some.text(None)  # type: ignore[arg-type]
    pole = largest_pole(model.A, [plant(0.8, steps=1)], lambda parts: regressed(parts[1:]).A)
    assert stability(*pole[1:]) == "undecided"
    still = np.zeros((5, 2)), np.zeros((4, 1))
    assert np.isnan(fit_percent(model, [still])).all()


def test_a_study_without_trainings_and_a_comparison_without_runs_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "no study" in error_of(capsys, "study", "status", str(tmp_path))
    (tmp_path / "none.yaml").write_text("problems: []\nseeds: 2\nvariants: {plain: {}}\n")
    told = error_of(capsys, "study", str(tmp_path / "none.yaml"), "--out", str(tmp_path / "out"))
    assert "'problems' is []" in told
    with pytest.raises(SystemExit, match="2"):
        main(["compare", str(tmp_path)])
    assert "expected two runs or more" in capsys.readouterr().err
    assert "--fields" in error_of(capsys, "evaluate", str(tmp_path), "--fields", "0")
    with pytest.raises(ValueError, match="evaluation_fields"):
        pdeloop.train("burgers", evaluation_fields=0)


@pytest.mark.parametrize(
    ("tool", "words"),
    [
        (simulation, ["--seeds", "3", "3"]),
        (mutants, ["--sample", "0", "--least", "0", "tuner_node.dispatch"]),
        (planted, ["--seeds", "0", next(iter(planted.BUGS))]),
    ],
)
def test_searches_of_nothing_find_it_wanting(
    tool: ModuleType, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # for tests that they run
    monkeypatch.setattr(sys, "argv", ["tool", *words])
    # They have no work, which is all that processes, and what mutants need, would be there for.
    if tool is mutants:
        monkeypatch.setattr(tool, "prepare", lambda modules: None)
    else:
        monkeypatch.setattr(tool, "processes", lambda: ThreadPoolExecutor(1))
    assert tool.main() == 1


def test_a_parametrised_test_without_a_case_fails(tmp_path: Path) -> None:
    file = tmp_path / "test_none.py"
    file.write_text("import pytest\n\n@pytest.mark.parametrize('x', [])\ndef test(x):\n    pass\n")
    command = [sys.executable, "-m", "pytest", "-q", "-c", str(ROOT / "pyproject.toml")]
    command += [f"--basetemp={tmp_path / 'base'}", "-p", "no:cacheprovider", str(file)]
    own = {**os.environ, "TMPDIR": str(tmp_path)}  # its workers have folders of their own there
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, env=own, check=False
    )
    assert done.returncode != 0 and "Empty parameter set" in done.stdout


def test_findings_without_a_script_are_not_as_before(tmp_path: Path) -> None:
    makefile = str(ROOT / "Makefile")
    done = subprocess.run(
        ["make", "-f", makefile, "findings"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0 and "as before" not in done.stdout
