"""A training comes to the same policy, whichever call that changes its folder is the last, or fails."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.crash_points import KINDS

LIMIT = 600.0
MEMORY_DISK = Path("/dev/shm")
"""There fsync does not wait; what is on the disk at a crash is decided by the test."""


def test_a_training_comes_to_the_same_policy_after_a_failure_at_any_call():
    where = MEMORY_DISK if os.access(MEMORY_DISK, os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=where) as folder:
        run = subprocess.run(
            [sys.executable, "-m", "tests.crash_points", folder],
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # no threads before a fork
            capture_output=True,
            text=True,
            timeout=LIMIT,
        )
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)
    assert all(result["failures"][kind] > 10 for kind in KINDS)
    assert result["wrong"] == []
