# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The check after the tests of each file sees what they leave behind."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.support import leftovers


def test_tests_have_a_temporary_folder_of_their_own(temporary_folder: Path) -> None:
    code = "import tempfile; print(tempfile.gettempdir())"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert child.stdout.strip() == tempfile.gettempdir() == str(temporary_folder)


def test_a_file_that_is_left_is_named(temporary_folder: Path) -> None:
    before = leftovers.files(temporary_folder)
    with tempfile.NamedTemporaryFile(suffix=".yaml", dir=temporary_folder) as file:
        with pytest.raises(AssertionError, match=Path(file.name).name):
            leftovers.check(temporary_folder, before, "they")
        leftovers.check(temporary_folder, leftovers.files(temporary_folder), "they")
    leftovers.check(temporary_folder, before, "they")


def test_folders_that_stay_are_those_of_the_product_and_of_multiprocessing(tmp_path: Path) -> None:
    for name in (f"pdeloop-plants-{os.getuid()}", "pymp-ab12", "pdeloop-ab12", "tmpab12"):
        (tmp_path / name).mkdir()
    assert leftovers.files(tmp_path) == {"pdeloop-ab12", "tmpab12"}


def test_a_process_that_goes_on_is_named(
    temporary_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leftovers, "PATIENCE", 0.0)
    code = "print('running', flush=True); input()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    child = subprocess.Popen([sys.executable, "-c", code], start_new_session=True, **pipes)
    try:
        # In the middle of exec a process has neither an environment nor a command.
        assert child.stdout.readline() == "running\n"
        with pytest.raises(AssertionError, match=r"leave processes: .*input\(\)"):
            leftovers.check(temporary_folder, set(), "they")
    finally:
        child.kill()
        child.communicate(timeout=60)
    leftovers.check(temporary_folder, leftovers.files(temporary_folder), "they")
