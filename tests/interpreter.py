# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A Python program in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
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
