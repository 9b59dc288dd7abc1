# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Trainings under random faults: every one ends with the undisturbed policy."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.soak import soak, text
from tests.support.small import SMALL

pytestmark = pytest.mark.topics


def test_random_faults_change_no_bit(tmp_path: Path):
    lines: list[str] = []
    how = {"problem": str(SMALL), "iterations": 60, "seed": 1, "folder": tmp_path / "soak"}
    report = soak(10.0, most=3, tell=lines.append, **how)
    told = "\n".join([*lines, text(report)])
    assert report.mismatches == 0, told
    assert report.trainings >= 1, told
    assert report.faults.total() == 3, told
    # The shortest of the trainings takes at least one step of model_based, of 4 rollouts.
    assert report.rollouts >= report.trainings * 6, told
