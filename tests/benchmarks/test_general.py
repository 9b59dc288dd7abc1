# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks general`: its families are what they say, and its table tells losses first."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import general, kept
from benchmarks.families import plants
from benchmarks.families.cases import CASES
from pdeloop import Problem, problem
from pdeloop.episode import rollout

EQUATIONS = [name for name, case in CASES.items() if case.equation]
PLANTS = [case.plant for case in CASES.values() if case.plant]


def problem_of(name: str) -> Problem:
    given = CASES[name].parameters()
    prefix = "physical."
    physical = {key.removeprefix(prefix): given.pop(key) for key in list(given) if prefix in key}
    return problem(CASES[name].base, physical=physical, **given)


def test_there_are_at_least_thirty_cases() -> None:
    assert len(CASES) >= 30
    assert {case.group for case in CASES.values()} >= {
        "as shipped",
        "rich initial fields",
        "variations",
        "noise and limits",
        "other equations",
        "coefficients of x",
        "two components",
        "plants of other kinds",
    }


@pytest.mark.parametrize("name", EQUATIONS)
def test_half_the_internal_step_changes_no_cost(name: str) -> None:
    """So that a table is about the PDE, and not about its integrator."""
    own = problem_of(name)
    finer = problem(
        own.source, **{**own.given, "integration_time": own.values["integration_time"] / 2}
    )
    costs = []
    for each in (own, finer):
        plant = each.plant()
        none = np.zeros((2, plant.n_a))
        costs.append(rollout(plant, lambda k, z, none=none: none, [1, 2], keep=False).costs.mean)
    np.testing.assert_allclose(*costs, rtol=1e-3)


@pytest.mark.parametrize("name", PLANTS)
def test_a_plant_steps_a_batch_as_it_steps_each(name: str) -> None:
    plant = getattr(plants, name)()
    rng = np.random.default_rng(3)
    z = np.stack([plant.initial_state(rng) for _ in range(3)])
    a = rng.standard_normal((3, plant.n_a))
    together = plant.step(z, a)
    apart = np.concatenate([plant.step(z[m : m + 1], a[m : m + 1]) for m in range(3)])
    assert together.shape == (3, plant.n_z) and np.isfinite(together).all()
    np.testing.assert_allclose(together, apart, rtol=1e-12, atol=1e-14)
    assert plant.target.shape == (plant.n_z,)


@pytest.mark.parametrize("name", PLANTS)
def test_a_plant_has_exact_derivatives(name: str) -> None:
    """<y, f' d> = <f'^T y, d> for any direction d, with f' d by central differences."""
    plant = getattr(plants, name)()
    rng = np.random.default_rng(5)
    z = np.stack([plant.initial_state(rng) for _ in range(2)])
    a = rng.standard_normal((2, plant.n_a))
    y, dz, da = (rng.standard_normal(part.shape) for part in (z, z, a))
    e = 1e-5
    along = (plant.step(z + e * dz, a + e * da) - plant.step(z - e * dz, a - e * da)) / (2 * e)
    on_z, on_a = plant.pull_back(z, a, y)
    expected = np.sum(y * along, axis=1)
    np.testing.assert_allclose(
        np.sum(on_z * dz, axis=1) + np.sum(on_a * da, axis=1), expected, rtol=1e-6
    )


@pytest.mark.parametrize("name", CASES)
def test_a_case_is_a_problem_that_can_be_trained_on(name: str) -> None:
    case = CASES[name]
    own = problem(case.base or None, **case.parameters())
    plant = own.plant()
    assert np.isfinite(plant.states).all()
    if case.plant:
        expected = getattr(plants, case.plant)
        assert (plant.n_z, plant.n_a) == (expected.n_z, expected.n_a)


@pytest.mark.parametrize("name", ["allen-cahn", "lorenz-96"])
def test_finished_trainings_are_kept_and_errors_are_rows(name: str, tmp_path: Path) -> None:
    options = {"fields": 1, "evaluation": 3, "folder": tmp_path}
    failed = general.train((name, 1, 0, "affine"), **options)  # one rollout is no budget
    assert "rollouts" in failed["error"]
    (path,) = tmp_path.iterdir()
    path.write_text(json.dumps({**failed, "error": "kept"}))
    assert general.train((name, 1, 0, "affine"), **options)["error"] == "kept"


def test_the_table_begins_with_what_lost_most() -> None:
    def row(case: str, adapted: float, budget: int = 20) -> dict[str, object]:
        costs = {"none": 4.0, "lqt": 2.0, "adapted": adapted}
        return {"case": case, "budget": budget, "seed": 0, **costs}

    rows = [row("burgers", 1.0), row("kdv", 1.0), row("kdv", 3.0), row("wave", 2e9)]
    failed = {"case": "allen-cahn", "budget": 20, "seed": 0, "error": "no model"}
    table = general.text({"rows": [*rows, failed], "bounds": {"kdv": {"affine": 0.5}}})
    lines = table.splitlines()[2:]
    assert [line.split(" | ")[0][2:] for line in lines] == ["allen-cahn", "wave", "kdv", "burgers"]
    assert lines[0].endswith("| 1 |")
    assert "diverged" in lines[1]
    assert "| 0.5 |" in lines[2] and "0.50 1.50" in lines[2]


def test_a_name_is_that_case_and_a_beginning_all_that_have_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def row(task: tuple[str, int, int, str], **_: object) -> dict[str, object]:
        case, budget, seed, _ = task
        return {"case": case, "budget": budget, "seed": seed, "adapted": 1.0}

    class Here:
        map = staticmethod(map)

        def __enter__(self) -> Here:
            return self

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr(general, "train", row)
    monkeypatch.setattr(kept, "processes", lambda _: Here())
    given = {"seeds": 1, "budgets": (20,), "folder": tmp_path}

    def trained(*cases: str) -> list[str]:
        general.run(cases, save=tmp_path / "rows.json", **given)
        return [each["case"] for each in json.loads((tmp_path / "rows.json").read_text())["rows"]]

    assert trained("burgers") == ["burgers"]
    assert len(trained("burgers", "kdv-modes,")) > 2
    assert set(trained()) == set(CASES)


def test_laws_are_rows_side_by_side() -> None:
    own = {"case": "kdv-modes", "budget": 20, "seed": 200, "none": 4.0, "lqt": 3.0}
    rows = [
        own | {"law": law, "adapted": cost} for law, cost in (("affine", 2.0), ("predictive", 1.0))
    ]
    found = general.summaries({"rows": rows, "bounds": {"kdv-modes": {"limit": 0.5}}})
    costs = {each["case"]: (each["adapted 20"], each["limit"]) for each in found}
    assert costs == {"kdv-modes": (2.0, 0.5), "kdv-modes, predictive": (1.0, 0.5)}
