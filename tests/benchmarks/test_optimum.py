# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The limits of `python -m benchmarks optimum`: against known optima; for whom they hold."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import optimum
from benchmarks.__main__ import parser
from benchmarks.bounds import (
    TRAINING_SEED,
    best_inputs,
    best_law,
    evaluation_seeds,
    initial_fields,
    law_costs,
    loop_of,
)
from benchmarks.descent import descend
from benchmarks.limits import FOLDER, find
from pde_sim_node.build import build_plant
from pdeloop.cli import run
from pdeloop.gradients import Gradients
from pdeloop.messages.problem import load_parameters
from tests.support.forked_workers import fork_workers
from tests.support.made_once import made_once
from tests.support.plants import Advection, plant_of
from tests.support.small import SMALL

FIELDS = 2
SIZE = {"horizon": 12, "n_a": 2, "integration_time": 0.01}
"""The small problem with fewer numbers to descend in: what a limit is does not depend on them."""
SETTINGS = [f"{name}={value}" for name, value in SIZE.items()]
GIVEN = {"fields": 4, "tolerance": 1e-6, "jobs": 1, "settings": SETTINGS}


def test_open_inputs_of_a_linear_plant_are_those_of_the_least_squares_problem():
    grid = {"n_z": 16, "n_a": 2, "width": 0.3, "horizon": 8}
    plant = plant_of(Advection(), **grid, sample_time=0.1, integration_time=0.05, action_weight=0.1)
    T, n_a, n_z = plant.horizon, plant.n_a, plant.n_z
    A = plant.evaluate(np.eye(n_z), np.zeros((n_z, n_a)))[0].T
    B = plant.evaluate(np.zeros((n_a, n_z)), np.eye(n_a))[0].T
    # z_k = A^k z_0 + sum_{j<k} A^{k-1-j} B a_j; weighted residuals of all stages below each other.
    z0 = plant.reset([4])[0].copy()
    rows, right = [], []
    for k in range(T):
        row = np.zeros((n_z, T * n_a))
        for j in range(k):
            row[:, j * n_a : (j + 1) * n_a] = np.linalg.matrix_power(A, k - 1 - j) @ B
        rows.append(row)
        right.append(plant.target - np.linalg.matrix_power(A, k) @ z0)
    rows.append(np.sqrt(0.1) * np.eye(T * n_a))
    right.append(np.zeros(T * n_a))
    matrix, vector = np.concatenate(rows), np.concatenate(right)
    exact = np.linalg.lstsq(matrix, vector, rcond=None)[0]
    least = float(np.sum((matrix @ exact - vector) ** 2)) / T
    gradients = Gradients(plant)
    found = descend(
        lambda a: gradients.of_actions(a, [4])[:2],
        np.zeros((T, 1, n_a)),
        tolerance=1e-12,
        iterations=200,
    )
    assert found.converged and found.cost == pytest.approx(least, rel=1e-9)
    np.testing.assert_allclose(found.x.ravel(), exact, atol=1e-5 * np.abs(exact).max())


def test_a_descent_goes_round_where_rollouts_diverge_and_says_when_it_was_cut_off():
    def valley(x):
        """Rosenbrock's function plus 1, infinite beyond x_0 = 0.9 times x_1 + 1."""
        a, b = x
        if a > 0.9 * b + 1:
            return np.inf, np.zeros(2)
        value = 1 + (1 - a) ** 2 + 100 * (b - a * a) ** 2
        return value, np.array([-2 * (1 - a) - 400 * a * (b - a * a), 200 * (b - a * a)])

    found = descend(valley, np.array([-1.2, 1.0]), tolerance=1e-10, iterations=500)
    assert found.converged and found.cost == pytest.approx(1.0, abs=1e-8)
    np.testing.assert_allclose(found.x, 1.0, atol=1e-3)
    assert found.gradient_norm < 1e-3
    cut = descend(valley, np.array([-1.2, 1.0]), tolerance=1e-10, iterations=5)
    assert cut.iterations == 5 and cut.cost > found.cost
    with pytest.raises(ValueError, match="must begin where the cost is finite"):
        descend(valley, np.array([5.0, 0.0]), tolerance=1e-4, iterations=5)


@pytest.fixture(scope="module")
def limits(tmp_path_factory) -> tuple[Path, dict]:
    """The limits of the small problem with two seeds, as the command line saves them."""

    def make(folder: Path) -> tuple[Path, dict]:
        given = {**GIVEN, "evaluation_fields": FIELDS}
        with pytest.MonkeyPatch.context() as patch:
            fork_workers(patch)
            (result,) = optimum.run([str(SMALL)], **given, seeds=2, save=folder)
        return folder, result

    return made_once(tmp_path_factory, "limits", make)


def values_of(**changes):
    return {**load_parameters(str(SMALL), SIZE), "evaluation_fields": FIELDS, **changes}


def test_the_limits_are_optima(limits):
    """No neighbouring law is better on its fields; better than LQT, and open inputs than both."""
    _, result = limits
    assert all(result["converged"])
    gradients = Gradients(build_plant(values_of()))
    fields = evaluation_seeds(TRAINING_SEED, 4)
    # The command's law of a seed again, which it does not keep.
    given = {"fields": 4, "evaluations": {}, "tolerance": 1e-6}
    cost, (U, theta), _ = optimum.law_of(1, values_of(), **given)
    s_r = U.T @ gradients.plant.target
    policy = np.hstack([theta[:, :-1], np.outer(theta[:, -1], s_r / (s_r @ s_r))])
    found = gradients.of_policy(U, policy, fields)
    assert found.cost == pytest.approx(cost, rel=1e-9)
    assert np.linalg.norm(policy) * np.linalg.norm(found.gradient) < 1e-2 * cost
    rng = np.random.default_rng(1)
    for _ in range(10):
        step = 0.02 * rng.standard_normal(policy.shape) * np.abs(policy).max()
        assert gradients.of_policy(U, policy + step, fields)[0] > cost
    for costs in result["costs"]:
        assert np.mean(costs["optimum"][0]) < np.mean(costs["lqt"][0])
        assert (np.array(result["open_loop"]["0"]) < np.array(costs["optimum"][0])).all()


def test_the_limits_from_zero_are_the_same(limits):
    _, result = limits
    plant, loop, first = loop_of(values_of(), "model_based")
    zero = np.zeros_like(first)
    theta = best_law(loop, zero, initial_fields(plant, evaluation_seeds(TRAINING_SEED, 4)), 1e-6)
    held_out = evaluation_seeds(0, FIELDS)
    law = np.mean(result["costs"][0]["optimum"][0])
    assert law_costs(plant, loop, theta, held_out).mean() == pytest.approx(law, rel=5e-3)
    for cost, seed in zip(result["open_loop"]["0"], held_out, strict=True):
        (again,), _ = best_inputs(loop, zero, initial_fields(plant, [seed]), 1e-6)
        assert again == pytest.approx(cost, rel=1e-3)


def test_limits_hold_for_their_plant_only(limits):
    folder, result = limits
    found = find(values_of(), folder)
    assert found is not None and found.tolist() == result["open_loop"]["0"]
    for change in ({"learning_rate": 1.0}, {"seed": 5}, {"reduced_order": 3}):
        assert find(values_of(**change), folder) is not None
    for change in (
        {"action_weight": 0.5},
        {"physical.viscosity": 2e-2},
        {"evaluation_seed": 9},
        {"evaluation_fields": 10},
        {"problem": "unknown"},
    ):
        assert find(values_of(**change), folder) is None, change
    # The same parameters, and a plant that does something else.
    known = json.loads((folder / "small.json").read_text())
    known["no_control_cost"] *= 1.01
    (folder / "other.json").write_text(json.dumps(known))
    assert find(values_of(problem="other"), folder) is None


def test_the_kept_limits_hold_for_the_shipped_problems():
    names = sorted(path.stem for path in FOLDER.glob("*.json"))
    assert names == ["allen-cahn", "burgers", "kdv"]
    for name in names:
        assert find(load_parameters(name, {})) is not None, (
            f"python -m benchmarks optimum {name} --save {FOLDER}"
        )


def test_a_law_has_the_order_that_is_asked_for():
    given = {"fields": 2, "evaluations": {}, "tolerance": 1e-2}
    for order in (2, 3):
        values = values_of(reduced_order=order, dmdc_order=order)
        _, (U, theta), _ = optimum.law_of(0, values, **given)
        assert U.shape[1] == order and theta.shape[1] == order + 1


@pytest.mark.usefixtures("forked_workers")
def test_the_command_line_prints_the_limits_and_refuses_nonsense(capsys, tmp_path):
    options = ["--seeds", "1", "--fields", "2", "--evaluation-fields", "1"]
    given = ["optimum", str(SMALL), *options, "--tolerance", "0.01", "--jobs", "1"]
    given += ["--settings", *SETTINGS]
    assert run(parser, [*given, "--save", str(tmp_path / "x")]) == 0
    shown = capsys.readouterr()
    assert "small" in shown.out and "optimum of class" in shown.out
    assert "law of seed 0" in shown.err
    assert (tmp_path / "x" / "small.json").is_file()
    for words in (["--seeds", "0"], ["--tolerance", "2"], ["--fields", "0"]):
        assert run(parser, ["optimum", str(SMALL), *words]) == 1
        assert words[0].lstrip("-") in capsys.readouterr().err
    assert run(parser, ["optimum", str(SMALL), "--settings", "n_zz=3"]) == 1
    assert "unknown parameter 'n_zz'" in capsys.readouterr().err
