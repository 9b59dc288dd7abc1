"""The limits of `python -m benchmarks optimum`: against known optima, and what reports make of them."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from benchmarks import optimum
from benchmarks.__main__ import parser
from benchmarks.descent import descend
from loop_interfaces.problem import config_folder, load_parameters
from pde_sim_node.build import build_plant
from pde_sim_node.equations import Burgers
from pde_sim_node.plant import DIVERGED_COST, Plant
from pdeloop import reference
from pdeloop.cli import run
from pdeloop.gradients import Gradients
from tests.small import SMALL
from tuner_node.results import RunFolderError

FIELDS = 3


@dataclass(frozen=True, kw_only=True)
class Linear(Burgers):
    """Advection and diffusion, a linear plant: the cost of open inputs is a quadratic function."""

    name = "linear"

    def linear_operator(self, k):
        return -0.05 * k**2 - 0.7j * k

    def multiplier(self, k):
        return np.zeros_like(k)


def test_open_inputs_of_a_linear_plant_are_those_of_the_least_squares_problem():
    plant = Plant(
        Linear(),
        n_z=16,
        n_a=2,
        width=0.3,
        sample_time=0.1,
        integration_time=0.05,
        horizon=8,
        state_weight=1.0,
        action_weight=0.1,
    )
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
    folder = tmp_path_factory.mktemp("limits")
    result = optimum.run(
        [str(SMALL)],
        seeds=2,
        fields=4,
        evaluation_fields=FIELDS,
        tolerance=1e-6,
        jobs=1,
        save=folder,
    )
    assert json.loads((folder / "small.json").read_text()) == json.loads(json.dumps(result[0]))
    return folder, result[0]


def values_of(**changes):
    return {**load_parameters(str(SMALL), {}), "evaluation_fields": FIELDS, **changes}


def test_the_limits_are_optima(limits):
    """No neighbouring law is better on its fields; better than LQT, and open inputs than both."""
    _, result = limits
    draw = result["evaluations"][0]
    for seed in ("0", "1"):
        law = result["laws"][seed]
        assert law["converged"] and law["gradient_norm"] < 1e-2
        job = optimum.LawJob(str(SMALL), int(seed), 4, (0,), FIELDS, 1e-6, 1000)
        again = optimum.optimise_law(job)
        assert again["cost"] == law["cost"]
        gradients = Gradients(build_plant(values_of()))
        fields = optimum.evaluation_seeds(optimum.TRAINING_SEED, 4)
        rng = np.random.default_rng(int(seed))
        for _ in range(10):
            step = 0.02 * rng.standard_normal(again["theta"].shape) * np.abs(again["theta"]).max()
            assert gradients.of_law(again["U"], again["theta"] + step, fields)[0] > law["cost"]
        assert np.mean(draw["optimum"][seed]) < np.mean(draw["lqt"][seed])
        assert (np.array(draw["open_loop"]) < np.array(draw["optimum"][seed])).all()
    checks = result["checks"]
    assert checks["law_from_zero"] == pytest.approx(checks["law"], rel=5e-3)
    assert checks["inputs_from_zero"] == pytest.approx(checks["inputs"], rel=1e-3)


def test_a_reference_holds_for_its_plant_only(limits):
    folder, result = limits
    found = reference.find(values_of(), folder=folder)
    assert found is not None and sorted(found.optimum) == [0, 1]
    assert found.open_loop.tolist() == result["evaluations"][0]["open_loop"]
    # What neither plant nor basis depends on may differ.
    assert reference.find(values_of(learning_rate=1.0, seed=5), folder=folder) is not None
    for change in (
        {"action_weight": 0.5},
        {"physical.viscosity": 2e-2},
        {"reduced_order": 3},
        {"identification_attempts": 1},
        {"evaluation_seed": 9},
        {"evaluation_fields": 10},
        {"problem": "unknown"},
    ):
        assert reference.find(values_of(**change), folder=folder) is None, change
    # The same parameters, and a plant that does something else.
    assert reference.find(values_of(), none_cost=1.0, folder=folder) is None


@pytest.mark.parametrize("content", ["", "{}", '{"format": 1, "parameters": 3}', "[" * 5000])
def test_a_broken_reference_is_an_error_that_says_what_to_do(tmp_path, content):
    (tmp_path / "small.json").write_text(content)
    with pytest.raises(RunFolderError, match="python -m benchmarks optimum --save"):
        reference.find(values_of(), folder=tmp_path)


def test_the_share_of_the_possible_gain():
    rows = np.array([[4.0, 6.0], [8.0, 12.0]])
    known = reference.Reference(
        lqt={3: rows[0], 4: rows[1]},
        optimum={3: rows[0] / 5, 4: rows[1] / 5},
        open_loop=np.array([0.5, 0.5]),
    )
    seeds = [3, 4]
    assert known.share(seeds, rows, rows) == 0.0
    assert known.share(seeds, rows, rows / 5) == 1.0
    # Of the means: LQT 7.5, optimum 1.5, reached 4.5.
    assert known.share(seeds, rows, 0.6 * rows) == pytest.approx(0.5)
    assert known.share([3, 99], rows, np.stack([0.6 * rows[0], rows[1]])) == pytest.approx(0.5)
    assert known.share([99, 98], rows, rows) is None
    assert known.share(seeds, 2 * rows, rows) is None
    assert known.share(seeds, rows, np.full((2, 2), DIVERGED_COST)) is None


def test_the_shipped_limits_hold_for_the_shipped_problems():
    """Their files fit the problems as they are now, and their numbers are ordered as limits are."""
    names = sorted(path.stem for path in (config_folder() / "optimum").glob("*.json"))
    assert names
    for name in names:
        found = reference.find(
            load_parameters(name, {"optimizer": "two_point", "identification_attempts": 10})
        )
        assert found is not None, (
            f"{name}: python -m benchmarks optimum {name} --save config/optimum"
        )
        for seed, best in found.optimum.items():
            assert found.open_loop.mean() < best.mean() < found.lqt[seed].mean()


def test_the_command_line_prints_the_limits_and_refuses_nonsense(capsys, tmp_path):
    options = ["--seeds", "1", "--fields", "2", "--evaluation-fields", "1", "--no-checks"]
    given = ["optimum", str(SMALL), *options, "--tolerance", "0.01", "--jobs", "1"]
    assert run(parser, [*given, "--save", str(tmp_path / "x")]) == 0
    shown = capsys.readouterr()
    assert "small" in shown.out and "optimum of class" in shown.out
    assert "law of seed 0" in shown.err
    assert (tmp_path / "x" / "small.json").is_file()
    for words in (["--seeds", "0"], ["--tolerance", "2"], ["--fields", "0"]):
        assert run(parser, ["optimum", str(SMALL), *words]) == 1
        assert words[0].lstrip("-") in capsys.readouterr().err
