# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks few_sensors`: finished trainings are kept, and each seed is in the table."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.estimator import values_of
from benchmarks.families.cases import CASES, OF_FEW_SENSORS, case_of
from benchmarks.few_sensors import interval, text, train
from pde_sim_node.build import build_plant
from pde_sim_node.instruments import InstrumentedPlant


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


@pytest.mark.parametrize("name", [*OF_FEW_SENSORS, "allen-cahn with V(x)", "kdv"])
def test_a_problem_may_be_a_case_of_the_other_benchmark(name: str) -> None:
    plant = build_plant(values_of(name, {"sensors": 16, "seed": 1}))
    assert isinstance(plant, InstrumentedPlant) and plant.state_size == 16
    assert name == "kdv" or case_of(name) in [*CASES.values(), *OF_FEW_SENSORS.values()]


def test_actuators_of_unequal_strengths_push_so_much() -> None:
    supports = build_plant(values_of("allen-cahn-modes, unequal strengths", {})).supports
    np.testing.assert_allclose(supports.max(axis=0), [0.5, 1.0, 1.5] * 4)
