# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks hidden_noise`: what the plant has is not what the training is told."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.hidden_noise import RIGHT, text, train, trained
from tests.support.small import SMALL

TASK = ("burgers", "two_point", 0.05, 0.0, 3)
QUICK = {"optimizer": "two_point", "rollouts": 5, "evaluation_fields": 1}


def test_a_finished_training_is_not_run_again_and_an_error_is_a_row(tmp_path: Path) -> None:
    kept = dict(zip(("problem", "optimizer", "noise", "told", "seed"), TASK, strict=True))
    kept |= {"none": 3.0, "lqt": 2.0, "adapted": 1.0, "found": 0.049}
    (tmp_path / "burgers-two_point-0.05-0-3-20.json").write_text(json.dumps(kept))
    assert train(TASK, rollouts=20, folder=tmp_path) == kept
    refused = train((*TASK[:4], 4), rollouts=1, folder=tmp_path)
    assert "rollouts" in refused["error"]
    right = {**kept, "told": RIGHT, "adapted": 0.9, "found": 0.0}
    head, _, wrong, rightly, error = text([kept, refused, right]).splitlines()
    assert head.count("|") == wrong.count("|") == rightly.count("|")
    assert wrong == "| burgers | two_point | 0.05 | none | 3 | 2, - | 1, - | 0.9 | 0.049, - |"
    assert rightly == "| burgers | two_point | 0.05 | 0.05 | 3 | 2 | 0.9 | 0.9 | - |"
    assert error.startswith("burgers, seed 4: ")


def test_the_plant_has_the_noise_and_the_training_is_told_another() -> None:
    quiet, noisy, told = (
        trained(str(SMALL), noise, declared, QUICK)
        for noise, declared in ((0.0, 0.0), (0.1, 0.0), (0.1, 0.03))
    )
    assert [own["noise"]["declared"] for own in (quiet, noisy, told)] == [0.0, 0.0, 0.03]
    # Without control the cost, of the true field, does not depend on readings.
    assert quiet["costs"]["none"] == pytest.approx(noisy["costs"]["none"], rel=1e-12)
    assert quiet["costs"]["lqt"] != noisy["costs"]["lqt"]
