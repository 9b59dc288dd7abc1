"""Memory that is given back after the start."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
from pathlib import Path
from loop_interfaces.memory import release_compiler
release_compiler()  # LLVM is not there yet: nothing to do

import numba
import numpy as np
from controller_node.policy import ProjectedLaw

def resident():
    found, counted = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        words = line.split()
        if not words[0].endswith(":"):
            counted = "libllvmlite" in line and words[1] == "r-xp"
        elif words[0] == "Rss:" and counted:
            found += int(words[1])
    return found

def law():
    one = ProjectedLaw([np.eye(8)[:, :2]], np.ones(8))
    one.set(np.arange(12.0).reshape(1, 3, 4))
    return one.actions(np.arange(8.0)[np.newaxis])

before, answer = resident(), law()
release_compiler()
after = resident()
assert np.array_equal(law(), answer)
assert numba.njit(lambda x: x + 1)(1) == 2  # compiled anew, by code that comes back from its file
print(before, after)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory is counted as Linux does it")
def test_the_compiler_is_given_back_and_comes_back() -> None:
    root = Path(__file__).parent.parent
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=600, cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    before, after = map(int, done.stdout.split())
    assert before > 5_000  # kB
    assert after < 0.1 * before
