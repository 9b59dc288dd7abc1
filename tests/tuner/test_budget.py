# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The budget: every rollout that the plant pays is counted, once, and no seed pays more."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

import numpy as np
import pytest

from pdeloop.cli import main
from pdeloop.in_process import LocalPair
from pdeloop.messages.parameter_file import yaml_text
from pdeloop.messages.spec import ParameterError
from pdeloop.messages.topics import CostColumn, StartColumn
from tests.support.small import CHECKED, FEW_STEPS, SMALL, parameters, same_bits, train_here
from tuner_node import checkpoint, training_state
from tuner_node.batch import BatchResult
from tuner_node.build import build_training
from tuner_node.results import summarise
from tuner_node.rollouts import CHECK
from tuner_node.training import Training

NOISE = {"measurement_noise": 0.05, "process_noise": 0.02}
BUDGETS: list[dict[str, Any]] = [
    {"optimizer": CHECKED, "rollouts": 12, "horizon": 10, **FEW_STEPS, **NOISE},
    {"optimizer": "two_point", "rollouts": 16},
    {"optimizer": "two_point", "iterations": 3},
]
PHASES = ("exploration", "check", "adaptation", "evaluation")


def finish(training: Training, values: dict[str, Any], paid: np.ndarray, batches: int = -1) -> int:
    """Run so many batches, or all; adds to `paid` (S, phases) what the plant rolls out.

    Seed 0 is identified again, and its laws are measured to be worse than no control.
    """
    pair, done = LocalPair(values), 0
    pair.follow(training)
    while done != batches and (batch := training.next_batch()) is not None:
        column = ("identify", "check", "adapt", "evaluate").index(training.phase)
        for row in batch.rows:
            paid[int(row[StartColumn.MODEL]), column] += 1
        result = pair.run(batch)
        if training.phase == "check" and training.pending[0] == 0:
            result.costs[1, CostColumn.MEAN] = result.costs[0, CostColumn.MEAN] + 1.0
        training.finish(result)
        pair.follow(training)
        done += 1
    return done


@pytest.mark.parametrize("options", BUDGETS, ids=lambda o: "-".join(map(str, o.values())))
def test_a_training_ended_and_continued_after_each_of_its_batches_is_the_same(tmp_path, options):
    """To the bit, with the noise it had; and its count is what the plant rolled out."""
    values = parameters(seeds=2, evaluation_fields=2, **options)
    paid = np.zeros((2, len(PHASES)), dtype=int)
    whole = build_training(values)
    batches = finish(whole, values, paid)
    expected = whole.budget.by_purpose()
    assert [[seed[name] for name in PHASES] for seed in expected] == paid.tolist()
    assert all(seed["total"] == sum(seed[name] for name in PHASES[:3]) for seed in expected)
    assert all(seed["adaptation"] > 0 and seed["evaluation"] == 6 + 1 for seed in expected)
    if "rollouts" in options:
        assert max(seed["total"] for seed in expected) <= options["rollouts"]
        last = {row["seed"]: row["rollouts"] for row in whole.history}
        assert list(last.values()) == [seed["total"] for seed in expected]
    else:
        assert [seed["adaptation"] for seed in expected] == [6] * 2
    parts = build_training(values)
    again = np.zeros_like(paid)
    for _ in range(batches):
        finish(parts, values, again, batches=1)
        checkpoint.save(tmp_path / "checkpoint", training_state.arrays_of(parts))
        parts = build_training(values)
        assert checkpoint.restore(
            tmp_path / "checkpoint", partial(training_state.restore, parts)
        ) == (True, [])
    assert parts.next_batch() is None
    assert parts.budget.by_purpose() == expected
    assert again.tolist() == paid.tolist()
    assert same_bits(parts.policies(), whole.policies())
    assert same_bits(parts.evaluation, whole.evaluation)
    assert same_bits(parts.starts(), whole.starts()) and not whole.starts()[0].any()
    assert (parts.generation, parts.law_seen) == (whole.generation, whole.law_seen)
    assert summarise(parts) == summarise(whole)


@pytest.mark.parametrize(
    ("rollouts", "explorations"), [(5, 1), (7, 1), (8, 2), (10, 2), (11, 3), (200, 3)]
)
def test_explorations_that_fail_are_paid_for_and_leave_a_step(rollouts, explorations):
    values = parameters(rollouts=rollouts, evaluation_fields=1)
    training, pair = build_training(values), LocalPair(values)
    while (batch := training.next_batch()) is not None and training.phase != "adapt":
        result = pair.run(batch)
        if training.phase == "check":  # every first law is worse than no control
            result.costs[0, 0], result.costs[1, 0] = 1.0, 2.0
        training.finish(result)
        pair.follow(training)
    # Never a law that was measured to be worse than no control.
    assert not training.starts().any()
    (spent,) = training.budget.by_purpose()
    assert (spent["exploration"], spent["check"]) == (explorations, CHECK * explorations)
    while (batch := training.next_batch()) is not None:
        training.finish(pair.run(batch))
    (spent,) = training.budget.by_purpose()
    assert spent["adaptation"] >= 2
    assert spent["total"] in (rollouts, rollouts - 1)  # two_point takes two at a time


def test_a_result_that_cannot_be_used_is_not_counted():
    values = parameters(rollouts=16)
    training, pair = build_training(values), LocalPair(values)
    result = pair.run(training.next_batch())
    with pytest.raises(ValueError, match="expected 1 models"):
        training.finish(BatchResult(result.costs, np.repeat(result.models, 2, axis=0)))
    assert training.progress == {"rollouts": [0], "budget": [16]}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"rollouts": 1},
            "'rollouts' is 1; expected at least 5: 1 for the exploration, 2 to check",
        ),
        ({"rollouts": 5, "optimizer": "model_based"}, "expected at least 6: .*4 for a step"),
        ({"rollouts": 2, "identification_attempts": 1}, "expected at least 3: 1 for .*, 2 for a"),
        ({"rollouts": 20, "iterations": 4}, "'rollouts' and 'iterations' both set the budget"),
        ({"iterations": 4, "optimizer": "model_based"}, "'iterations' is 4; expected 'rollouts'"),
    ],
)
def test_a_budget_that_cannot_be_kept_is_refused(options, words):
    with pytest.raises(ParameterError, match=words):
        build_training(parameters(**options))


def test_the_default_is_20_rollouts_in_all():
    assert parameters()["rollouts"] == 20
    assert parameters(iterations=3)["rollouts"] == 0
    training = build_training(parameters())
    assert training.progress == {"rollouts": [0], "budget": [20]}


def test_the_smallest_budgets_make_a_step():
    for options in ({"rollouts": 5}, {"rollouts": 6, "optimizer": "model_based", **FEW_STEPS}):
        training = train_here(parameters(evaluation_fields=1, **options))
        assert not np.array_equal(training.policies(), training.starts())


def test_the_command_line_refuses_before_there_is_a_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for words in (["--rollouts", "1"], ["--rollouts", "30", "--iterations", "4"]):
        assert main(["train", str(SMALL), "--in-process", *words]) == 1
        assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_results_say_what_the_rollouts_were_for(tmp_path, capsys):
    out = tmp_path / "run"
    words = ["--rollouts", "17", "--seeds", "2", "--out", str(out)]
    assert main(["train", str(SMALL), "--in-process", *words]) == 0
    shown = capsys.readouterr().out
    assert "17 rollouts per seed (exploration 1, check 2, adaptation 14)" in shown
    result = json.loads((out / "result.json").read_text())
    spent = {"exploration": 1, "check": 2, "adaptation": 14, "evaluation": 31, "total": 17}
    assert result["rollouts"] == [spent, spent]
    assert "iterations" not in result and result["changed"] == [True, True]
    rows = [json.loads(line) for line in (out / "progress.jsonl").read_text().splitlines()]
    told = [row["rollouts"] for row in rows if row["event"] == "adapted" and row["seed"] == 0]
    assert told == [5, 7, 9, 11, 13, 15, 17]
    phases = {row["phase"]: row for row in rows if row["event"] == "phase"}
    assert phases["adapt"]["rollouts"] == [3, 3] and phases["adapt"]["budget"] == [17, 17]


def test_a_run_that_did_not_count_its_rollouts_is_read_but_not_continued(tmp_path, capsys):
    out = tmp_path / "run"
    words = ["train", str(SMALL), "--in-process", "--rollouts", "5", "--out", str(out)]
    assert main(words) == 0
    known = {k: v for k, v in parameters().items() if k not in ("rollouts", "iterations")}
    (out / "parameters.yaml").write_text(yaml_text({**known, "iterations": 40}))
    assert main(["evaluate", str(out), "--fields", "1"]) == 0
    (out / "result.json").unlink()
    capsys.readouterr()
    assert main(["train", "--resume", str(out), "--in-process"]) == 1
    assert "is from an older version, which did not count its rollouts" in capsys.readouterr().err
