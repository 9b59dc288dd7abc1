# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop evaluate`: costs of the built-in plant and law, and of no other."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pdeloop
from pde_sim_node.build import build_plant
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.cli import main
from pdeloop.evaluation import changed, outcome
from pdeloop.messages.spec import ParameterError
from tests.support.small import SMALL
from tuner_node.narration import failed, warnings

COSTS = ("none", "lqt", "adapted")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: Any) -> Path:
    out: Path = tmp_path_factory.mktemp("evaluated") / "run"
    words = ["--in-process", "--rollouts", "13", "--seeds", "2", "--out", str(out)]
    assert main(["train", str(SMALL), *words]) == 0
    return out


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy to be changed."""
    for name in ("parameters.yaml", "policy.npz", "result.json"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    return tmp_path


def test_a_run_says_who_controlled_and_evaluates_to_its_own_costs(finished, capsys):
    result = json.loads((finished / "result.json").read_text())
    assert result["controller"] == {"nodes": [], "law": "affine"}
    assert main(["evaluate", str(finished), "--json"]) == 0
    costs = json.loads(capsys.readouterr().out)
    assert costs == result["costs_by_field"]


def test_a_noisy_run_evaluates_to_its_own_costs(tmp_path, capsys):
    noise = "    measurement_noise: 0.05\n    process_noise: 0.02\n"
    (tmp_path / "noisy.yaml").write_text(SMALL.read_text() + noise)
    words = ["--in-process", "--rollouts", "13", "--out", str(tmp_path / "run")]
    assert main(["train", str(tmp_path / "noisy.yaml"), *words]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "run"), "--json"]) == 0
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert json.loads(capsys.readouterr().out) == result["costs_by_field"]


def test_the_mean_field_is_one_whatever_the_seed(finished, capsys):
    found = []
    for seed in ("1", "2"):
        assert main(["evaluate", str(finished), "--mean-field", "--seed", seed, "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[0] == found[1]
    assert {len(fields) for seeds in found[0].values() for fields in seeds} == {1}


def test_a_policy_that_is_no_better_than_no_control_is_told_with_its_seed():
    costs = {
        "none": np.array([[4.0, 5.0], [4.0, 5.0]]),
        "adapted": np.array([[1.0, 2.0], [1.0, 9.0]]),
    }
    costs["lqt"] = costs["none"]
    words = "after adaptation the cost is not below that without control"
    (told,) = warnings(outcome(costs, 3))
    assert told.startswith(f"{words} for seed 4; likely causes: ") and "pdeloop check" in told
    (told,) = warnings(outcome({name: table[1:] for name, table in costs.items()}, 4))
    assert told.startswith(f"{words}; likely causes: ")
    assert warnings(outcome({name: table[:1] for name, table in costs.items()}, 3)) == []
    lost = {**costs, "none": np.full((2, 2), DIVERGED_COST)}
    assert not failed(outcome(lost, 3)) and failed(outcome({**costs, "adapted": lost["none"]}, 3))


def refused(capsys: Any, run: Path) -> str:
    assert main(["evaluate", str(run), "--fields", "1"]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    return str(shown.err)


@pytest.mark.parametrize(("controller", "value"), [("lqt", 0.5), ("adapted", 1e9)])
def test_another_control_law_is_refused_and_its_node_named(run, capsys, controller, value):
    result = json.loads((run / "result.json").read_text())
    result["controller"] = {"nodes": ["/lab/mine"], "law": "not seen"}
    result["costs_by_field"][controller] = [[value] * 10] * 2
    (run / "result.json").write_text(json.dumps(result))
    said = refused(capsys, run)
    assert "the control law of the run was not the built-in one (its controller: /lab/mine)" in said
    assert ("diverged" if value == 1e9 else "0.5") in said


def test_another_plant_is_refused(run, capsys):
    result = json.loads((run / "result.json").read_text())
    result["costs_by_field"] = {name: [[0.5] * 10] * 2 for name in COSTS}
    (run / "result.json").write_text(json.dumps(result))
    assert "the plant of the run was not the built-in one" in refused(capsys, run)
    with np.load(run / "policy.npz") as arrays:
        content = {**arrays, "model": np.ones((2, 57, 4))}
    np.savez(run / "policy.npz", **content)
    assert "the plant of the run was not the built-in one" in refused(capsys, run)


def test_rounding_of_another_machine_is_not_another_plant(run, capsys):
    result = json.loads((run / "result.json").read_text())
    for name in COSTS:
        rows = result["costs_by_field"][name]
        result["costs_by_field"][name] = [[1.01 * cost for cost in row] for row in rows]
    (run / "result.json").write_text(json.dumps(result))
    assert main(["evaluate", str(run), "--fields", "1"]) == 0
    assert "adapted" in capsys.readouterr().out
    # A plant with another fingerprint is another one if a single cost differs by more than 1e-6.
    (run / "result.json").write_text(json.dumps(result | {"plant": result["plant"] + 1}))
    assert "the plant of the run was not the built-in one (with another fingerprint)" in refused(
        capsys, run
    )


def test_a_plant_of_another_source_that_computes_the_same_costs_is_the_same(run):
    result = json.loads((run / "result.json").read_text())
    (run / "result.json").write_text(json.dumps(result | {"plant": result["plant"] + 1}))
    assert main(["evaluate", str(run), "--fields", "1"]) == 0


def test_policies_that_diverge_are_no_success(run, capsys):
    result = json.loads((run / "result.json").read_text())
    with np.load(run / "policy.npz") as arrays:
        content = dict(arrays)
    content["policy"] = 1e8 * np.abs(content["policy"])
    np.savez(run / "policy.npz", **content)
    result["costs_by_field"]["adapted"] = [[1e9] * 10] * 2
    (run / "result.json").write_text(json.dumps(result))
    assert main(["evaluate", str(run)]) == 1
    shown = capsys.readouterr()
    assert "WARNING: every rollout of the adapted policies diverged" in shown.err
    assert "1e+09" not in shown.out


def test_an_unfinished_run_says_how_to_go_on(run, capsys):
    (run / "result.json").unlink()
    assert "pdeloop train --resume" in refused(capsys, run)


class Tracked(pdeloop.Dynamics):
    """Its argument changes its cost, of a target for each step, and the time of a step."""

    n_z, n_a, horizon = 4, 1, 20

    def __init__(
        self, goal: float = 0.5, dt: float = 0.1, n_z: int = 4, r: float = 1.0, bound: float = 1e6
    ) -> None:
        self.n_z, self.sample_time, self.action_weight, self.divergence_bound = n_z, dt, r, bound
        self.target = np.tile(np.linspace(0.0, goal, 21)[:, None], (1, n_z))

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(self.n_z)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        z = 0.9 * np.roll(z, 1)
        z[0] += a[0]
        return z


def test_a_plant_whose_arguments_change_what_it_supplies_is_evaluated(tmp_path):
    out = tmp_path / "run"
    pdeloop.train(plant=Tracked(), rollouts=8, optimizer="two_point", out=out)
    run = pdeloop.load_run(out)
    found = changed(run, {"physical.goal": 0.7, "physical.dt": 0.2})
    assert found.values["sample_time"] == 0.2
    assert (
        build_plant(found.values).cost.texts
        == pdeloop.problem(plant=Tracked(0.7, 0.2)).plant().cost.texts
    )
    found = changed(run, {"physical.r": 3.0, "physical.bound": 50.0})
    assert build_plant(found.values).action_weight == found.values["action_weight"] == 3.0
    assert found.values["divergence_bound"] == 50.0
    # What was given in its place is kept, and so is what changes.
    own = replace(run, values={**run.values, "divergence_bound": 1e5})
    assert changed(own, {"physical.bound": 50.0}).values["divergence_bound"] == 1e5
    given = {"physical.bound": 50.0, "divergence_bound": 60.0}
    assert changed(run, given).values["divergence_bound"] == 60.0
    with pytest.raises(ParameterError, match=r"a state of 4 numbers .* the changed plant has 6"):
        changed(run, {"physical.n_z": 6})
    with pytest.raises(ParameterError, match="leave it out"):
        changed(run, {"sample_time": 0.3})
