# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks few_sensors`: finished trainings are kept, and each seed is in the table."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.few_sensors import interval, text, train


def test_a_finished_training_is_not_run_again_and_an_error_is_a_row(tmp_path: Path) -> None:
    kept = {"problem": "wave", "sensors": 8, "noise": 0.1, "law": "observer", "seed": 3}
    kept |= {"none": 3.0, "lqt": 2.0, "adapted": 1.0}
    (tmp_path / "wave-8-0.1-observer-3-20.json").write_text(json.dumps(kept))
    assert train(("wave", 8, 0.1, "observer", 3), rollouts=20, folder=tmp_path) == kept
    refused = train(("wave", 8, 0.1, "observer", 4), rollouts=1, folder=tmp_path)
    assert "rollouts" in refused["error"]
    head, _, row, error = text([kept, refused]).splitlines()
    assert head.count("|") == row.count("|")
    assert row == "| wave | 8 | 0.1 | observer | 3 | 2, - | 1, - | - |"
    assert error.startswith("wave, seed 4: ")


def test_several_seeds_have_a_mean_with_its_interval() -> None:
    # Student's t of two degrees of freedom is 4.303 at 97.5 %.
    assert interval([1.0, 2.0, 3.0]) == f"2 ± {4.3027 / 3**0.5:.4g}"
    assert interval([1.0]) == "-"
