# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop new`: what it writes runs, its test holds for PDEs of every kind, and no name breaks it."""

from __future__ import annotations

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pde_sim_node.plants.loading import OWN_PLANTS
from pdeloop.cli import FAILED, main
from pdeloop.commands.new import write
from pdeloop.messages.problem import read_problem, shipped_problems
from pdeloop.messages.spec import ParameterError

GROWS = "test_a_small_wave_grows_as_the_equation_says"
LINEAR = "return self.rate - self.diffusivity * k**2"
FACTOR, REACTION = "return np.full_like(k, -1.0)", "return u * u * u"
START = "return draw(rng, 0.4, 0.8) * np.sin(2 * np.pi * x / self.length)"
TARGET = "return 0.5 * np.cos(2 * np.pi * x / self.length)"

SCALAR_KINDS: dict[str, dict[str, str]] = {
    "dispersive": {
        LINEAR: "return -((1j * k) ** 3)",
        FACTOR: "return -3j * k",
        REACTION: "return u * u",
    },
    "of fifth order": {LINEAR: "return 1e-3 * (1j * k) ** 5 - 1e-4 * k**4"},
    "of fractional order": {LINEAR: "return self.rate - self.diffusivity * np.abs(k) ** 1.5"},
    "carried along": {LINEAR: "return -2j * k - self.diffusivity * k**2"},
    "nonlocal": {LINEAR: "return -1j * k * np.abs(k)", FACTOR: "return -0.5j * k"},
    "with a linear part in g": {REACTION: "return u * u * u - 2.0 * u"},
    "with a constant in g": {REACTION: "return u * u - 1.0"},
    "with a transcendental g": {
        REACTION: "return math.sin(u)",
        "import numpy as np": "import math\n\nimport numpy as np",
    },
    "about a uniform field": {START: START + " + 0.7"},
}
LINEAR_KINDS: dict[str, dict[str, str]] = {
    "linear and dispersive": {LINEAR: "return -((1j * k) ** 3)"},
    "linear in two real components": {
        LINEAR: "return _rows(k, [[0 * k, 0 * k + 1], [-(k**2), -0.1 * k**2]])"
    },
    "linear in two complex components": {
        LINEAR: "return _rows(k, [[-1j * k, 0 * k + 2], [0 * k - 3, 1j * k**3]])"
    },
}
ROWS = """

def _rows(k, entries):
    return np.moveaxis(np.array(entries), 2, 0)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder, with no code allowed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PDELOOP_EQUATIONS", "")
    return tmp_path


def own_tests(folder: Path) -> dict[str, Callable[[], Any]]:
    """The tests that `pdeloop new my-pde` wrote into a folder, of the class that is there now."""
    found = runpy.run_path(str(folder / "my-pde" / "test_my_pde.py"))
    return {name: value for name, value in found.items() if name.startswith("test_")}


def changed(folder: Path, changes: dict[str, str], file: str = "my_pde.py") -> None:
    path = folder / "my-pde" / file
    text = path.read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)


def test_what_new_writes_runs_and_passes_its_own_tests(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new", "my-pde"]) == 0
    *_, told, _ = capsys.readouterr().out.splitlines()
    words = told.removeprefix("next: pdeloop ").split()
    assert main(["check", "my-pde/my-pde.yaml"]) == FAILED  # a file alone runs no code
    assert "name it yourself: --equation" in capsys.readouterr().err
    assert main([*words, "--json"]) == 0
    findings = json.loads(capsys.readouterr().out)
    assert len(findings) == 5 and all(one["good"] for one in findings)
    assert (folder / "my-pde.png").read_bytes().startswith(b"\x89PNG")
    tests = own_tests(folder)
    assert len(tests) == 2
    for test in tests.values():
        test()


@pytest.mark.parametrize("kind", SCALAR_KINDS)
def test_the_test_that_new_writes_holds_for_every_kind_of_pde(folder: Path, kind: str) -> None:
    write("my-pde", folder)
    changed(folder, SCALAR_KINDS[kind])
    own_tests(folder)[GROWS]()


@pytest.mark.parametrize("kind", LINEAR_KINDS)
def test_the_test_that_new_writes_holds_for_linear_pdes(folder: Path, kind: str) -> None:
    write("my-pde", folder)
    changed(folder, LINEAR_KINDS[kind] | {"Equation": "LinearEquation"})
    if "two" in kind:
        both = {
            START: f"u = {START.removeprefix('return ')}\n        return np.stack([u, 0 * u])",
            TARGET: f"u = {TARGET.removeprefix('return ')}\n        return np.stack([u, 0 * u])",
            "    order:": '    components: ClassVar[tuple[str, ...]] = ("u", "v")\n    order:',
        }
        changed(folder, both)
        with (folder / "my-pde" / "my_pde.py").open("a") as own:
            own.write(ROWS)
    own_tests(folder)[GROWS]()


def test_the_test_that_new_writes_fails_where_the_step_is_too_coarse(folder: Path) -> None:
    """The reaction is the part that the step only approximates: 400 of its e-foldings in a step."""
    write("my-pde", folder)
    changed(folder, {REACTION: "return u * u * u + 4e4 * u"})
    with pytest.raises(AssertionError):
        own_tests(folder)[GROWS]()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("../x", "cannot be the name"),
        ("9x", "cannot be the name"),
        ("2d-heat", "beginning with a letter"),
        ("My-PDE", "lower-case letters"),
        ("None", "cannot be the name"),
        ("wärme", "cannot be the name"),
        ("\udcff", "cannot be the name"),
        ("a b", "cannot be the name"),
        ("my--pde", "cannot be the name"),
        ("my-", "cannot be the name"),
        ("", "cannot be the name"),
        ("a" * 61, "cannot be the name"),
        ("burgers", "shipped"),
        ("allen_cahn", "shipped"),
        ("class", "Python already has 'class'"),
        ("numpy", "Python already has 'numpy'"),
        ("none", "would be 'None'"),
        ("true", "would be 'True'"),
        ("exception", "would be 'Exception'"),
        ("warning", "would be 'Warning'"),
        ("value-error", "would be 'ValueError'"),
        ("field", "would be 'Field', which its own file imports"),
        ("equation", "would be 'Equation', which its own file imports"),
        ("test-pde", "pytest would take test_pde.py"),
        ("conftest", "pytest would take conftest.py"),
    ],
)
def test_new_refuses_a_name(
    folder: Path, name: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new", name]) == FAILED
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    "name", ["no", "yes", "null", "on", "heat-2d", "a1", "list", "match", "split", "print", "x-y_z"]
)
def test_new_takes_a_name_that_is_a_word_of_python_or_yaml(folder: Path, name: str) -> None:
    files, equation = write(name, folder)
    assert read_problem(files[1])["problem"] == name
    kind = equation.rpartition(":")[2]
    assert runpy.run_path(str(files[0]))[kind].name == name


def test_a_name_in_two_words_is_refused_with_the_help_of_new(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["new", "my", "pde"])
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert "see `pdeloop new --help`" in told and "usage: pdeloop new" in told
    assert list(folder.iterdir()) == []


def test_new_overwrites_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "own").mkdir()
    assert main(["new", "own"]) == FAILED
    assert "already exists" in capsys.readouterr().err
    assert list((folder / "own").iterdir()) == []


def test_every_shipped_problem_is_refused(folder: Path) -> None:
    for name in shipped_problems():
        with pytest.raises(ParameterError, match="shipped"):
            write(name, folder)


def test_a_plant_that_new_writes_runs_and_passes_its_own_tests(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(OWN_PLANTS.variable, "")
    assert main(["new", "interval", "--plant"]) == FAILED
    assert "'interval' is a shipped plant" in capsys.readouterr().err
    assert main(["new", "my-rod", "--plant"]) == 0
    *_, told, _ = capsys.readouterr().out.splitlines()
    words = told.removeprefix("next: pdeloop ").split()
    assert main(["check", "my-rod/my-rod.yaml"]) == FAILED  # a file alone runs no code
    assert "name it yourself: --plant" in capsys.readouterr().err
    assert main([*words, "--json"]) == 0
    findings = json.loads(capsys.readouterr().out)
    assert len(findings) == 6 and all(one["good"] for one in findings)
    monkeypatch.syspath_prepend(str(folder / "my-rod"))
    found = runpy.run_path(str(folder / "my-rod" / "test_my_rod.py"))
    assert (
        len([name for name in found if name.startswith("test_")]) == 2
    )  # the other one is a check
    found["test_a_small_wave_grows_at_its_rate_and_the_error_falls_with_the_grid_and_the_step"]()
    plant = found["MyRod"]()
    assert np.allclose(plant.x, plant.grid.axes[0].points), "it is where its grid says"
