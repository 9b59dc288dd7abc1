# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training comes to the same policy, whichever call that concerns its folder is the last, or fails.

These are samples; `.ci/run` tries every call.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.support.crash_points import KINDS
from tests.support.interpreter import python
from tests.support.mounts import mountable

POWER = "power"


def failures(kinds: Sequence[str]) -> dict[str, int]:
    """How many failures of each kind there were, none of which changed anything."""
    # No threads before a fork.
    words = ("-m", "tests.support.crash_points", *kinds, "--most", "5")
    run = python(*words, OPENBLAS_NUM_THREADS="1")
    result = json.loads(run.stdout)
    assert result["wrong"] == []
    counts: dict[str, int] = result["failures"]
    return counts


def test_a_training_comes_to_the_same_policy_after_a_failure_at_any_call():
    kinds = [kind for kind in KINDS if kind not in (POWER, "often")]
    counts = failures(kinds)
    assert all(counts[kind] >= 3 for kind in kinds)


def test_a_training_comes_to_the_same_policy_after_a_power_cut_that_loses_what_is_not_synced():
    if not mountable("mkfs.ext4") or not Path("/dev/loop-control").exists():
        pytest.skip("mounting an ext4 file system needs root, e2fsprogs and loop devices")
    assert failures([POWER])[POWER] >= 3
