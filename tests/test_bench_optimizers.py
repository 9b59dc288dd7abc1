"""`python -m benchmarks optimizers`: the same training as everywhere else, and its table."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks import robustness
from benchmarks.optimizers import Job, run, table, train
from pde_sim_node.plant import DIVERGED_COST
from tests.small import SMALL, parameters, train_here
from tuner_node.training import CHECK


def test_it_is_the_training_of_the_loop():
    job = Job(
        problem=str(SMALL),
        optimizer="gauss_newton",
        seed=3,
        rollouts=12,
        evaluation_seed=2024,
        evaluation_fields=2,
        fresh_fields=1,
        attempts=None,
        marks=(4,),
        options={},
    )
    measured = train(job)
    options = {"seed": 3, "rollouts": 15, "optimizer": "gauss_newton"}
    training = train_here(parameters(**options))
    rows = [
        {name: value for name, value in row.items() if name not in ("event", "seed")}
        for row in training.history
    ]
    before = 1 + CHECK  # the exploration and its check
    told = [{**row, "rollouts": before + row["rollouts"]} for row in measured["history"]]
    assert told == rows
    assert list(measured["costs"]) == ["0", "4", "12"]
    assert np.mean(measured["costs"]["12"]) < np.mean(measured["costs"]["0"])
    assert json.loads(json.dumps(measured)) == measured


def test_the_table_has_means_worst_seeds_and_worst_fields():
    common = {"problem": "p", "diverged_rollouts": 1, "fresh_diverged": 0, "fresh_costs": [1.0]}
    results = [
        {**common, "costs": {"0": [4.0, 4.0], "80": [1.0, 3.0]}},
        {**common, "costs": {"0": [8.0, 8.0], "80": [2.0, 2.0]}},
    ]
    head, row = table(results).splitlines()
    assert head.split()[:5] == ["problem", "0", "rollouts", "80", "rollouts"]
    assert row.split() == ["p", "6", "(8)", "2", "(2)", "-62.5%", "-", "1.50", "2", "0/2"]


def test_a_setting_that_is_none_is_refused_in_one_sentence():
    with pytest.raises(ValueError, match="--set is 'fields'; expected NAME=VALUE"):
        run(problem=[str(SMALL)], settings=["fields"])


def test_the_table_of_other_settings_says_what_diverged_and_where_there_was_no_model():
    common = {"problem": "p", "none": [4.0, 4.0], "lqt": [2.0, 3.0], "attempts": [1, 5]}
    noisy = {**common, "options": {"measurement_noise": 0.1}, "accepted": [3, 7]}
    rows = [
        {**noisy, "adapted": [1.0, 2.0]},
        {**noisy, "lqt": [2.0, 5.0], "adapted": [1.0, 0.1 * DIVERGED_COST]},
        {"problem": "p", "options": {"sensors": 2}, "failed": "why"},
    ]
    lines = robustness.text(rows).splitlines()
    assert lines[0] == "**p**"
    assert lines[-3:] == [
        "| measurement_noise 0.1 | 1/5 | 4 | 2.5 (3) | 0 of 2 | 1.5 (2) | 3/7 |",
        "| measurement_noise 0.1 | 1/5 | 4 | 3.5 (5) | 1 of 2 | diverges (1 of 2) | 3/7 |",
        "| sensors 2 | no reduced model | | | | | |",
    ]
