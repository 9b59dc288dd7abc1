# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Modules next to a file of user code: found after all installed packages, which they cannot hide."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

BASES = {"plant": "Dynamics", "law": "Law"}
LOADED = """
import sys
from pdeloop.messages.own_code import OwnCode
kind = OwnCode(sys.argv[1], "ALLOWED", {}).load(sys.argv[2])
print(kind.__mro__[1].__module__.partition(".")[0], kind.number)
"""


@pytest.mark.parametrize("word", BASES)
def test_a_folder_that_holds_a_checkout_hides_no_installed_package(
    tmp_path: Path, word: str
) -> None:
    """Its empty folder `pdeloop` is beside the user's file, which imports `pdeloop`."""
    (tmp_path / "pdeloop").mkdir()
    (tmp_path / "beside.py").write_text("NUMBER = 7\n")
    own = tmp_path / "own.py"
    own.write_text(
        f"import beside, pdeloop\nclass Own(pdeloop.{BASES[word]}):\n    number = beside.NUMBER\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = [sys.executable, "-P", "-c", LOADED, word, f"{own}:Own"]
    ended = subprocess.run(
        words, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    package, number = ended.stdout.split()
    assert package in ("pdeloop", "pde_sim_node") and number == "7"
