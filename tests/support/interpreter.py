# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A Python program in a process of its own."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

from pdeloop.process.affinity import SOLVER

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 600.0
"""Seconds, on a busy machine that may have to compile first."""


def python(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """`python WORDS...`, which must succeed, with the project's modules to import."""
    done = subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    assert done.returncode == 0, done.stderr
    return done


def helps_solver(process: int, thread: int) -> bool:
    """True for a thread that helps a plant with its step."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/task/{thread}/comm").read_text().strip() == SOLVER
    return False
