# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The wheel: what it holds, and that it works where it is installed, from a folder of the user's."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from functools import partial
from pathlib import Path
from zipfile import ZipFile

import pytest

from tests.support.colcon_workspace import ROOT, add_compiled, copy_sources
from tests.support.made_once import made_once
from tests.support.small import SMALL

CLEAN = {
    name: value
    for name, value in os.environ.items()
    if not name.startswith(("PYTHON", "PIP_")) and name != "VIRTUAL_ENV"
}


def run(*words: object, cwd: Path) -> str:
    """What a command prints, which must succeed."""
    done = subprocess.run(
        list(map(str, words)), cwd=cwd, env=CLEAN, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def build_wheel(folder: Path) -> Path:
    """The wheel, built from a clean copy of the sources."""
    how = ("--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", folder)
    sources = copy_sources(folder / "sources")
    run(sys.executable, "-m", "pip", "wheel", *how, sources, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


def install(wheel: Path, prefix: Path) -> Path:
    """A virtual environment into which the wheel was installed from a local index.

    It has the packages of the present environment, so that nothing is fetched, but for the project.
    """
    venv.create(prefix, symlinks=True)
    (library,) = prefix.glob("lib/python*/site-packages")
    own = ("pdeloop", "__editable__", "__pycache__")
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if not path.name.startswith(own):
            (library / path.name).symlink_to(path)
    index = prefix / "index" / "pdeloop"
    index.mkdir(parents=True)
    shutil.copy(wheel, index)
    (index / "index.html").write_text(f'<a href="{wheel.name}">{wheel.name}</a>')
    pip = (sys.executable, "-m", "pip", "--python", prefix / "bin" / "python")
    asked = ("install", "--quiet", "--index-url", index.parent.as_uri(), "pdeloop[gym,report]")
    run(*pip, "--isolated", "--disable-pip-version-check", *asked, cwd=prefix)
    add_compiled(library)
    return prefix


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "wheel", build_wheel)


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "installed-wheel", partial(install, wheel))


def test_it_holds_the_packages_their_files_and_the_configuration(wheel: Path) -> None:
    with ZipFile(wheel) as archive:
        names = set(archive.namelist())
    data = {name.partition(".data/data/")[2] for name in names if ".data/data/" in name}
    for path in (ROOT / "config").rglob("*"):
        if path.is_file():
            assert f"share/pdeloop/{path.relative_to(ROOT)}" in data, path
    code = {name for name in names if ".dist-info/" not in name and ".data/" not in name}
    packages = {name.partition("/")[0] for name in code}
    assert {name for name in packages if not name.endswith("_node")} == {"pdeloop"}
    for package in packages:
        for path in (ROOT / package).rglob("*"):
            if path.is_file() and path.suffix not in (".pyc", ".nbi", ".nbc"):
                assert str(path.relative_to(ROOT)) in code, path
    assert not {name for name in code if name.startswith(("tests/", "benchmarks/", "docs/"))}


def test_its_commands_run_from_any_folder(installed: Path, tmp_path: Path) -> None:
    told = run(installed / "bin" / "pdeloop", "problems", cwd=tmp_path)
    assert str(installed / "share/pdeloop/config/problems/burgers.yaml") in told
    assert "pdeloop 0." in run(installed / "bin" / "pdeloop", "--version", cwd=tmp_path)


def test_it_trains_a_problem_of_the_users_folder(installed: Path, tmp_path: Path) -> None:
    shutil.copy(SMALL, tmp_path / "mine.yaml")
    words = ("--in-process", "--rollouts", "7", "--evaluation-fields", "2", "--out", "results")
    told = run(installed / "bin" / "pdeloop", "train", "mine.yaml", *words, cwd=tmp_path)
    assert "mean stage cost after adaptation" in told
    assert (tmp_path / "results" / "result.json").is_file()
    assert str(ROOT) not in (tmp_path / "results" / "result.json").read_text()


def test_its_environments_are_registered_there(installed: Path, tmp_path: Path) -> None:
    program = (
        "import gymnasium, pdeloop.environments, pathlib\n"
        "env = gymnasium.make('pdeloop/Burgers-v0', n_z=32, horizon=30)\n"
        "env.reset(seed=1)\n"
        "print(env.step(env.action_space.sample())[0].shape, pdeloop.environments.__file__)"
    )
    told = run(installed / "bin" / "python", "-c", program, cwd=tmp_path)
    assert told.startswith(f"(32,) {installed}")
