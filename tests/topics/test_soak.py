"""Trainings under random faults: every one ends with the undisturbed policy."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.small import SMALL
from tests.soak import as_dict, soak, text

pytestmark = pytest.mark.topics


def test_random_faults_change_no_bit(tmp_path: Path):
    lines: list[str] = []
    report = soak(
        10.0,
        most=6,
        problem=str(SMALL),
        iterations=60,
        seed=1,
        tell=lines.append,
        folder=tmp_path / "soak",
    )
    told = "\n".join([*lines, text(as_dict(report))])
    assert report.mismatches == 0, told
    assert report.trainings >= 1, told
    assert report.faults.total() == 6, told
    # The shortest of the trainings takes at least one step of Gauss-Newton: 6 rollouts of 30 steps.
    assert report.environment_steps >= report.trainings * 6 * 30, told
    assert all(last < first + 30 for first, last in report.memory_mb.values()), told
