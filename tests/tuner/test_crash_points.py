# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training comes to the same policy, whichever call that changes its folder is the last, or fails."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path

from tests.support.crash_points import KINDS
from tests.support.interpreter import python

MEMORY_DISK = Path("/dev/shm")
"""There fsync does not wait; what is on the disk at a crash is decided by the test."""


def test_a_training_comes_to_the_same_policy_after_a_failure_at_any_call():
    where = MEMORY_DISK if os.access(MEMORY_DISK, os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=where) as folder:
        # No threads before a fork.
        run = python("-m", "tests.support.crash_points", folder, OPENBLAS_NUM_THREADS="1")
    result = json.loads(run.stdout)
    assert all(result["failures"][kind] > 10 for kind in KINDS)
    assert result["wrong"] == []
