# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks baselines`: methods of others on the same fields, with the same budget."""

from __future__ import annotations

import importlib.util
import itertools
import json
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from benchmarks import baselines
from benchmarks.__main__ import parser
from benchmarks.baselines import (
    STUDIES,
    TEST,
    TUNING_SEEDS,
    VALIDATION,
    iqm,
    refuse_other_constants,
    run,
)
from benchmarks.methods import (
    LIBRARIES,
    METHODS,
    Identified,
    LikeliestField,
    Predictive,
    evaluation_fields,
    measure,
    refitted,
)
from pde_sim_node.build import build_plant
from pde_sim_node.instruments import InstrumentedPlant
from pde_sim_node.plant import DIVERGED_COST, Plant
from pde_sim_node.plants.batch import BatchPlant
from pdeloop import cli
from pdeloop.episode import projected_law, rollout
from pdeloop.finished_run import interval
from pdeloop.method.adapt.registry import OWN_OPTIMIZERS
from pdeloop.method.design import lqt
from pdeloop.method.reduce.reduced_model import ReducedModel
from pdeloop.study import Study, StudyError
from pdeloop.study.results import Ended, read_study, reading, writing
from pdeloop.study.training import train_one
from tests.support.small import FEW_FITS, SMALL, parameters

CONSTANTS: dict[str, dict[str, Any]] = {
    "cma-es": {"sigma": 0.01, "population": 4},
    "mpc": {"steps": 5},
    "lqg": {"whole": False},
    "true-model": {"candidates": 16},
    "dfo-ls": {"radius": 0.03, "directions": 2},
    "opinf": {"operators": "cAHB", "regularizer": 0.1},
    "sindy": {"degree": 1, "threshold": 0.001},
}
ROLLOUTS = 11
AGENTS = ("ppo", "sac", "crossq")
"""Need the extras rl and rivals, and have tests of their own."""


def values_of(method: str) -> dict[str, Any]:
    sensors = {"sensors": 8} if method in ("lqg", "true-model") else {}
    return {**parameters(rollouts=ROLLOUTS, optimizer="model_based", **FEW_FITS), **sensors}


def costs(files: dict[str, bytes]) -> tuple[np.ndarray, int]:
    result = json.loads(files["result.json"])
    return np.array(result["costs_by_field"]["adapted"][0]), result["rollouts"][0]["total"]


@pytest.mark.parametrize("method", sorted({*METHODS, "model-based"} - {"no-control", *AGENTS}))
def test_a_method_improves_on_no_control_pays_for_each_rollout_and_sees_no_field_of_a_table(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    library, extra = LIBRARIES.get(method, ("numpy", ""))
    if importlib.util.find_spec(library) is None:
        pytest.skip(f"{library} is not installed: extra {extra}")
    values = values_of(method)
    asked: list[int] = []
    reset = BatchPlant.reset

    def counted(self: BatchPlant, seeds: Any, *rest: Any) -> Any:
        asked.extend(np.ravel(seeds).tolist())
        return reset(self, seeds, *rest)

    nothing, free = costs(measure("no-control", {}, values))
    monkeypatch.setattr(BatchPlant, "reset", counted)
    if method in METHODS:
        files = measure(method, CONSTANTS.get(method, {}), values)
    else:
        files = train_one(values)
    found, paid = costs(files)
    test = evaluation_fields({**values, "evaluation_seed": TEST})
    learnt_from = [seed for seed in asked if seed not in test]
    # A training repeats its first rollout after its evaluation.
    again = len(learnt_from) - paid
    assert again == 0 or (again == 1 and learnt_from[-1] in learnt_from[:-1])
    assert 0 < paid <= ROLLOUTS and free == 0
    assert not {*learnt_from} & {*evaluation_fields({**values, "evaluation_seed": VALIDATION})}
    assert {*test} <= {*asked} and found.mean() < nothing.mean()


def test_the_likeliest_field_is_the_true_one_where_it_is_a_candidate() -> None:
    values = parameters(sensors=4)
    sensed, true = build_plant(values), build_plant({**values, "sensors": 0})
    assert isinstance(sensed, InstrumentedPlant)
    gains = np.random.default_rng(0).standard_normal((true.n_a, true.n_z))
    law = lambda k, states: 0.1 * (states - true.target) @ gains.T  # noqa: E731
    estimated = LikeliestField(sensed, true, law, [3, 4, 5])
    found, whole = (
        rollout(*pair, [5, 3]).costs.mean for pair in ((sensed, estimated), (true, law))
    )
    np.testing.assert_allclose(found, whole, rtol=1e-12)


@pytest.mark.parametrize("file", sorted(STUDIES.glob("*.yaml")), ids=lambda file: file.stem)
def test_a_variant_is_of_the_optimizer_that_it_is_named_after(file: Path) -> None:
    """Whatever the default is: the tables that name these files stay those of their columns."""
    content = yaml.safe_load(file.read_text())
    for label, table in content["variants"].items():
        chosen = {**content["settings"], **table}["optimizer"]
        if (name := label.replace("-", "_")) in OWN_OPTIMIZERS.offered():
            assert chosen == name
        else:
            assert chosen in OWN_OPTIMIZERS.offered()


def test_the_splits_are_disjoint() -> None:
    values = parameters()
    test, validation = (
        evaluation_fields({**values, "evaluation_seed": seed, "evaluation_fields": 1000})
        for seed in (TEST, VALIDATION)
    )
    assert not {*test} & {*validation} and len({*test, *validation}) == 2000
    study = baselines.Study.of({"problems": [str(SMALL)], "seeds": 12})
    assert not {*study.seeds} & {*TUNING_SEEDS}


@pytest.fixture
def plant() -> Plant:
    return build_plant(parameters())


def test_a_law_whose_rollouts_all_diverged_is_followed_by_another_exploration() -> None:
    values = parameters(rollouts=4, reduced_order=3)
    designed: list[int] = []

    def design(plant: Plant, data: list[Any]) -> Any:
        designed.append(len(data))
        return lambda k, states: np.full((len(states), plant.n_a), 1e9)

    refitted(values, design, back=True)
    # An exploration, what it made diverge, an exploration, and two rollouts of the last law.
    assert designed == [1, 2, 2]
    designed.clear()
    refitted(values, design)
    assert designed == [1] * 4


def designs(plant: Plant, limit: float, steps: int) -> tuple[Predictive, Any, np.ndarray]:
    """MPC and LQ tracking of one model, and S = R + B'PB."""
    rng = np.random.default_rng(0)
    model = ReducedModel(
        A=rng.standard_normal((3, 3)) / 2,
        B=rng.standard_normal((3, plant.n_a)),
        U=np.linalg.qr(rng.standard_normal((plant.n_z, 3)))[0],
    )
    gains = lqt.track(model, state_weight=1.0, action_weight=1.0)
    known = Identified(model, gains, model.U.T @ plant.target, ())
    law = Predictive(known, parameters(action_limit=limit), steps)
    S = np.eye(plant.n_a) + model.B.T @ gains.P @ model.B
    return law, projected_law(plant, model.U, gains.policy), S


@pytest.mark.parametrize("steps", [1, 7])
def test_mpc_without_limits_is_the_lqt_law_whatever_its_horizon(plant: Plant, steps: int) -> None:
    mpc, lqt_law, _ = designs(plant, 0.0, steps)
    states = np.random.default_rng(1).standard_normal((2, plant.n_z))
    np.testing.assert_allclose(mpc(0, states), lqt_law(0, states), atol=1e-4)


def test_the_action_of_mpc_within_limits_is_optimal(plant: Plant) -> None:
    """Of min (a - a*)' S (a - a*), |a| <= limit: the gradient is 0, or points outwards."""
    limit, tolerance = 0.3, 1e-4
    mpc, lqt_law, S = designs(plant, limit, 1)
    states = 3 * np.random.default_rng(1).standard_normal((2, plant.n_z))
    actions, wanted = mpc(0, states), lqt_law(0, states)
    gradient = (actions - wanted) @ S
    free = np.abs(actions) < limit - tolerance
    assert np.abs(actions).max() <= limit + tolerance and 0 < free.sum() < free.size
    assert np.abs(gradient[free]).max() < 1e-3
    assert (gradient[~free] * np.sign(actions[~free]) <= 1e-3).all()
    assert np.abs(actions - np.clip(wanted, -limit, limit)).max() > 1e-2


def test_the_interval_is_that_of_all_resamples() -> None:
    sample = np.array([0.0, 1.0, 10.0, 100.0])
    every = [iqm(np.array(drawn)) for drawn in itertools.product(sample, repeat=4)]
    low, high = interval((sample,), iqm) or (np.nan, np.nan)
    assert (low, high) == tuple(np.quantile(every, [0.025, 0.975], method="inverted_cdf"))


def write(folder: Path, method: str, seed: int, found: list[float], **more: Any) -> None:
    result = {"costs_by_field": {"adapted": [found]}, "rollouts": [{"total": 20}], **more}
    content = json.dumps(result).encode()
    with writing(folder, Study.of({"problems": [str(SMALL)], "seeds": 4})) as results:
        results.add([Ended.well(f"small/{method}/{seed}", {}, {"result.json": content})])


def test_the_table_has_the_best_first_and_counts_what_diverges(tmp_path: Path) -> None:
    for seed in range(4):
        lost = DIVERGED_COST if seed == 3 else 3.0
        write(tmp_path, "worse", seed, [3.0, lost])
        write(tmp_path, "better", seed, [1.0 + seed, 1.0 + seed])
    rows = baselines.table(tmp_path, "small", 20)
    assert [(row["method"], row["diverged"], row["cost"]) for row in rows] == [
        ("better", 0, 2.5),
        ("worse", 1, 3.0),
    ]
    assert rows[0]["costs"] == [1.0, 2.0, 3.0, 4.0]
    rows = [{"problem": "p", **row} for row in rows]
    lines = baselines.text({"limits": {"p": 2.0}, "rows": rows}).splitlines()
    assert lines[0] == "| p | 20 rollouts | over the best known |"
    assert lines[2].startswith("| better | 2.5 (") and lines[2].endswith(") | 25.0 % |")
    assert lines[3].startswith("| worse | 3 (") and lines[3].endswith("to diverged) | 50.0 % |")
    assert lines[4] == "| best known inputs | 2 | 0 |"


def test_the_table_has_a_column_for_each_budget_and_says_which_methods_diverged():
    row = {"problem": "p", "method": "a", "seeds": 3, "interval": None, "diverged": 0}
    rows = [
        {**row, "budget": 20, "cost": 4.0, "interval": (3.0, 5.0)},
        {**row, "budget": 40, "cost": 2.0},
        {**row, "method": "b", "budget": 40, "cost": DIVERGED_COST, "diverged": 2},
    ]
    for each in rows:
        each["costs"] = [each["cost"]]
    lines = baselines.text({"limits": {"p": None}, "rows": rows}).splitlines()
    assert lines == [
        "| p | 20 rollouts | 40 rollouts | over the best known |",
        "|---|---|---|---|",
        "| a | 4 (3 to 5) | 2 | - |",
        "| b |  | diverged (2 of 3) | - |",
    ]


def test_results_of_other_constants_are_refused(tmp_path: Path) -> None:
    from functools import partial

    write(tmp_path, "mpc", 0, [1.0], constants={"steps": 5})
    refuse_other_constants(tmp_path, {"mpc": partial(measure, "mpc", {"steps": 5})})
    with pytest.raises(ValueError, match=r"constants \{'steps': 5\}, not \{'steps': 6\}; give"):
        refuse_other_constants(tmp_path, {"mpc": partial(measure, "mpc", {"steps": 6})})


STUDY = f"""
problems: [{SMALL}]
seeds: 2
variants: {{two-point: {{optimizer: two_point}}}}
methods: {{no-control: {{}}, lqt-again: {{}}}}
"""


@contextmanager
def here(count: int | None) -> Iterator[Executor]:
    with ThreadPoolExecutor(1) as pool:
        yield pool


def test_a_comparison_is_a_study_that_is_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(baselines, "pool", here)
    file, folder = tmp_path / "small.yaml", tmp_path / "runs"
    file.write_text(STUDY)
    how: dict[str, Any] = {"rollouts": [9], "settings": ["evaluation_fields=2"], "folder": folder}
    found = run([str(file)], **how)
    assert {(row["method"], row["seeds"]) for row in found["rows"]} == {
        ("no-control", 2),
        ("lqt-again", 2),
        ("two-point", 2),
    }
    assert found["rows"][-1]["method"] == "no-control" and found["limits"] == {"small": None}

    def ended() -> dict[str, float]:
        with reading(folder / "small/9") as results:
            return {row["name"]: row["ended"] for row in results.rows("name, ended")}

    written, lost = ended(), "small/lqt-again/1"
    with writing(folder / "small/9", read_study(folder / "small/9")) as results:
        results.forget([lost])
    assert run([str(file)], **how) == found
    now = ended()
    assert [name for name, at in written.items() if now[name] != at] == [lost]
    with pytest.raises(StudyError, match="holds another study"):
        run([str(file)], **{**how, "seeds": 1})


def test_what_a_method_needs_is_said_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    how: dict[str, Any] = {"folder": tmp_path}
    with pytest.raises(
        ValueError, match=r"ppo\+plain needs stable_baselines3: pip install .*\[rl\]"
    ):
        run(["kdv"], methods=["model-based", "ppo+plain"], **how)
    with pytest.raises(ValueError, match=r"mpc needs osqp: pip install 'pdeloop\[bench\]'"):
        run(["kdv"], methods=["mpc"], **how)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(
    importlib.util.find_spec("stable_baselines3") is None,
    reason="stable-baselines3 is not installed: extra rl",
)
@pytest.mark.filterwarnings("ignore:jax:DeprecationWarning")  # in imports of sbx
@pytest.mark.parametrize(
    ("method", "constants"),
    [
        ("ppo", {"agent": "plain", "environments": 2, "episodes": 2}),
        ("ppo", {"agent": "informed", "environments": 2, "episodes": 4, "log_std_init": -1.5}),
        ("sac", {"agent": "plain", "learning_starts": 4}),
        ("sac", {"agent": "informed", "environments": 2, "learning_starts": 4}),
        pytest.param(
            "crossq",
            {"agent": "plain", "environments": 2, "learning_starts": 4},
            marks=pytest.mark.skipif(
                importlib.util.find_spec("sbx") is None, reason="sbx is not installed: extra rivals"
            ),
        ),
    ],
)
def test_agents_pay_for_each_rollout_and_are_functions_of_the_seed(
    method: str, constants: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {**parameters(rollouts=9, seeds=1), "seed": 3}
    asked: list[int] = []
    reset = BatchPlant.reset

    def noted(self: BatchPlant, seeds: Any, *rest: Any) -> Any:
        asked.extend(np.ravel(seeds).tolist())
        return reset(self, seeds, *rest)

    monkeypatch.setattr(BatchPlant, "reset", noted)
    first, again = (METHODS[method](values, **constants) for _ in range(2))
    for split in (TEST, VALIDATION):
        assert not {*asked} & {*evaluation_fields({**values, "evaluation_seed": split})}
    seeds, costs = [1, 2], []
    for pair, law, paid in (first, again):
        # An exploration and a check of two rollouts, where the agent is told of them.
        before = 3 if constants["agent"] == "informed" else 0
        update = constants.get("episodes") or constants.get("environments", 1)
        assert paid == before + (9 - before) // update * update
        costs.append(rollout(pair.plant, law, seeds, keep=False).costs.mean)
    assert np.array_equal(*costs) and np.isfinite(costs[0]).all()
    other = METHODS[method]({**values, "seed": 4}, **constants)
    assert not np.array_equal(rollout(other[0].plant, other[1], seeds).costs.mean, costs[0])


def test_the_command_line_hands_the_program_its_options_alone(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.run(parser, ["baselines", "kdv", "--methods", "mcp"]) == 1
    assert capsys.readouterr().err.startswith(
        "pdeloop: no method mcp; expected some of model-based"
    )


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ({"studies": ["kdv"], "methods": ["mcp"]}, "no method mcp; expected some of model-based"),
        ({"studies": ["kvd"]}, "no study .*kvd.yaml; expected one of allen-cahn, burgers, "),
        (
            {"studies": ["kdv"], "settings": ["sensors"]},
            "'sensors' is not a setting; expected NAME=JSON",
        ),
    ],
)
def test_a_comparison_that_cannot_be_is_refused_in_one_sentence(
    words: dict[str, Any], why: str
) -> None:
    with pytest.raises(ValueError, match=why):
        run(**words)
