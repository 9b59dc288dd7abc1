# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a person is told of a training."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest

from pdeloop.cli import main
from pdeloop.display import Display
from pdeloop.in_process import LocalPair, train
from tests.support.small import SMALL, parameters
from tuner_node.build import build_training
from tuner_node.narration import (
    IDLE,
    Narration,
    closing_lines,
    exit_code,
    failed,
    misjudged_noise,
    warnings,
)
from tuner_node.results import difference, summarise
from tuner_node.rollouts import CHECK, EVALUATED


def phase(name: str, rollouts: list[int], budget: int = 20) -> dict[str, Any]:
    seeds = len(rollouts)
    return {"event": "phase", "phase": name, "rollouts": rollouts, "budget": [budget] * seeds}


def adapted(seed: int, rollouts: int, cost: float | None) -> dict[str, Any]:
    row = {"event": "adapted", "seed": seed, "rollouts": rollouts, "diverged": int(cost is None)}
    return row if cost is None else row | {"cost": cost}


def checked(seed: int, lqt: float, lost: int = 0, again: bool = False) -> dict[str, Any]:
    accepted = not lost and lqt < 5.0
    row = {"event": "checked", "seed": seed, "none": 5.0, "lqt": lqt, "accepted": accepted}
    return row | {"again": again, "diverged": {"none": 0, "lqt": lost}}


def told(rows: list[dict[str, Any]], seed: int = 0, seeds: int = 1) -> list[str]:
    narration = Narration(seed, seeds)
    return [line for row in rows for line in narration.lines(row)]


def test_one_seed_is_told_event_by_event():
    rows = [
        phase("check", [1]),
        checked(3, 2.5e8, lost=1, again=True),
        checked(3, 9.0),
        phase("adapt", [18]),
        adapted(3, 20, 1.25),
        phase("evaluate", [20]),
    ]
    assert told(rows, seed=3) == [
        "check",
        "  seed 3: a rollout costs 5 without control, diverged with LQT; no better, exploring again",
        "  seed 3: a rollout costs 5 without control, 9 with LQT; "
        "no better, and no other exploration is left: a poor warm start",
        "adapt",
        "  20 rollouts: cost 1.25",
        "evaluate",
    ]


def test_of_several_seeds_mean_and_range_are_told_in_one_line():
    rows = [phase("check", [1] * 3), checked(0, 2.0), checked(1, 9.0, again=True)]
    rows += [checked(2, 2.5e8, lost=1, again=True), phase("identify", [9] * 3)]
    assert told(rows, seeds=3)[1] == (
        "  3 seeds: a rollout costs 5 without control, 5.5 (2 to 9) and 1 diverged with LQT; "
        "no better for 2 of them, exploring again"
    )


def test_the_status_is_of_all_seeds_and_a_diverged_law_says_so():
    narration = Narration(4, 3)
    narration.lines(phase("adapt", [9, 9, 18]))
    assert (narration.done, narration.budget) == (36, 60)
    narration.lines(adapted(4, 11, None))
    assert (narration.done, narration.status) == (38, "diverged")
    narration.lines(adapted(5, 11, 1.0))
    narration.lines(adapted(6, 20, 3.0))
    assert (narration.done, narration.status) == (42, "cost 2 (1 to 3) and 1 diverged")


def test_a_real_training_with_a_law_that_diverges_never_says_a_billion(capsys):
    values = parameters(seeds=2, rollouts=13, evaluation_fields=2)
    training, pair = build_training(values), LocalPair(values)
    stream = io.StringIO()
    display = Display(0, 2, stream)
    while (batch := training.next_batch()) is not None:
        if training.phase == "check":
            batch.policies[CHECK - 1] = 1e6  # the first law of the first seed
        for row in training.finish(pair.run(batch)):
            display.row(row)
        pair.follow(training)
        display.row(phase(training.phase, [9, 9]))
    shown = stream.getvalue()
    assert "and 1 diverged with LQT; no better for 1 of them" in shown
    assert "e+0" not in shown


def summary(**changes: Any) -> dict[str, Any]:
    spent = {"exploration": 1, "check": 8, "adaptation": 11, "evaluation": 6, "total": 20}
    return {
        "seed": 0,
        "seeds": 2,
        "costs": {"none": [4.0, 4.0], "lqt": [2.0, 3.0], "adapted": [1.0, 2.0]},
        "reduction": {"ratio_of_means": 0.4, "mean_of_ratios": 0.4167},
        "diverged": {"none": 0, "lqt": 0, "adapted": 0},
        "evaluation_rollouts": 4,
        "changed": [True, True],
        "improved": True,
        "rollouts": [spent, {**spent, "exploration": 2, "check": 16, "total": 29}],
        "seconds": 1.0,
        **changes,
    }


def test_the_closing_words_have_the_ranges_the_budget_and_the_folder():
    lines = closing_lines("kdv", summary(), "runs/a")
    assert lines == [
        "kdv, seeds 0 to 1: 20 to 29 rollouts per seed (exploration 1 to 2, check 8 to 16, "
        "adaptation 11) in 1.0 s",
        "  mean stage cost without control  4",
        "  mean stage cost with LQT         2.5 (2 to 3)",
        "  mean stage cost after adaptation 1.5 (1 to 2)   "
        "(40.0 % below LQT; on average over the seeds 41.7 % below LQT)",
        "  results in runs/a",
    ]
    assert warnings(summary()) == [] and not failed(summary())


def test_a_gain_on_a_law_that_is_worse_than_no_control_is_told_against_no_control():
    costs = {"none": [4.0, 4.0], "lqt": [2.0, 30.0], "adapted": [1.0, 2.0]}
    words = "at least as much as no control; the adapted one costs 62.5 % less than no control"
    assert any(line.endswith(words) for line in closing_lines("kdv", summary(costs=costs), ""))
    assert not any("at least as much" in line for line in closing_lines("kdv", summary(), ""))
    costs["adapted"] = costs["none"]  # no control was kept
    words = "at least as much as no control; the adapted one costs as much as no control"
    assert any(line.endswith(words) for line in closing_lines("kdv", summary(costs=costs), ""))


def test_a_plant_that_costs_nothing_without_control_has_no_share_of_that():
    costs = {"none": [0.0, 0.0], "lqt": [2.0, 3.0], "adapted": [1.0, 2.0]}
    assert "adaptation 1.5" in closing_lines("kdv", summary(costs=costs), "")[3]


def test_an_optimiser_that_tells_no_cost_has_not_diverged():
    narration = Narration(3, 1)
    narration.lines({"event": "phase", "phase": "adapt", "rollouts": [3], "budget": [20]})
    narration.lines({"event": "adapted", "seed": 3, "rollouts": 5})
    assert narration.progress == "  5 of 20 rollouts"
    narration.lines(adapted(3, 7, None))
    assert narration.progress == "  7 of 20 rollouts: diverged"


def test_what_adapted_nothing_is_no_gain():
    lines = closing_lines("kdv", summary(changed=[False, False]), "")
    assert not any("LQT;" in line or "% below" in line for line in lines)
    assert "  nothing was adapted: the policies are those that the adaptation started from" in lines


def test_averages_of_different_signs_say_which_side_each_is_on():
    reduction = {"ratio_of_means": -1.504, "mean_of_ratios": 0.12}
    line = closing_lines("kdv", summary(reduction=reduction), "")[3]
    assert line.endswith("(150.4 % above LQT; on average over the seeds 12.0 % below LQT)")
    reduction = {"ratio_of_means": 0.3, "mean_of_ratios": -0.76}
    line = closing_lines("kdv", summary(reduction=reduction), "")[3]
    assert line.endswith("(30.0 % below LQT; on average over the seeds 76.0 % above LQT)")
    assert "-" not in line


@pytest.mark.parametrize(
    ("lqt", "adapted", "words"),
    [
        ([2.0], [2.5], "  the adapted law costs more than the LQT law"),
        ([2.0, 3.0], [2.5, 1.0], "more than the LQT law for 1 of 2 seeds: 4"),
        ([2.0, 3.0], [1.0, 3.5], "more than the LQT law for 1 of 2 seeds: 5"),
        ([2.0, 3.0], [2.5, 3.5], "more than the LQT law for 2 of 2 seeds: 4, 5"),
        ([2.0, 3.0], [2.0, 2.9], "  mean stage cost after adaptation 2.45 (2 to 2.9)"),
    ],
)
def test_the_seeds_whose_law_became_worse_are_named_and_no_other(lqt, adapted, words):
    costs = {"none": [9.0] * len(lqt), "lqt": lqt, "adapted": adapted}
    improved = all(a <= b for a, b in zip(adapted, lqt, strict=True))
    changes = {"seeds": len(lqt), "seed": 4, "costs": costs, "improved": improved}
    text = closing_lines("kdv", summary(**changes), "")[-1]
    assert (words in text and text.endswith(words)) or (improved and words in text)


def test_several_publishers_of_a_topic_are_a_warning():
    found = summary(several_publishers={"/action": ["/controller_node", "/stranger"]})
    assert warnings(found) == [
        "several nodes published /action: /controller_node, /stranger; expected one"
    ]


def test_a_cost_above_no_control_is_a_warning_that_names_the_seeds():
    worse = summary(costs={"none": [4.0, 4.0], "lqt": [2.0, 5.0], "adapted": [1.0, 4.5]})
    (told,) = warnings(worse)
    words = "after adaptation the cost is not below that without control for seed 1"
    assert told == f"{words}; likely causes: {IDLE}"
    assert not failed(worse)
    lost = summary(costs=worse["costs"], diverged={"none": 0, "lqt": 0, "adapted": 1})
    assert " for seed 1; 1 of 4 rollouts diverged; likely" in warnings(lost)[0]


def test_fields_that_cost_nothing_without_control_are_nothing_to_control():
    found = summary(costs={"none": [0.0, 0.0], "lqt": [0.0, 0.0], "adapted": [0.0, 0.0]})
    (told,) = warnings(found)
    assert "there is nothing to control" in told and "likely causes" not in told


@pytest.mark.parametrize(("adapted", "said"), [(3.9, True), (3.7, False), (4.1, False)])
def test_a_law_that_saves_next_to_nothing_is_told_with_likely_causes(adapted, said):
    costs = {"none": [4.0], "lqt": [4.0], "adapted": [adapted]}
    lines = closing_lines("kdv", summary(seeds=1, changed=[True], costs=costs), "")
    assert (
        any("control saves only 2.5 % of the cost without it: actions" in t for t in lines) == said
    )


def test_one_law_that_costs_otherwise_on_the_same_fields_is_a_plant_that_does_not_repeat():
    costs = {"none": [4.0], "lqt": [2.0], "adapted": [2.1]}
    kept = summary(seeds=1, changed=[False], costs=costs)
    assert "one law cost otherwise when it ran again" in warnings(kept)[0]
    assert warnings(summary(seeds=1, changed=[True], costs=costs)) == []
    for same in (2.0, 4.0):  # the first law, or no control, from which it started
        costs["adapted"] = [same]
        told = warnings(summary(seeds=1, changed=[False], costs=costs))
        assert not any("one law cost otherwise" in text for text in told)


def test_a_law_that_costs_more_than_no_control_has_an_exit_code_of_its_own():
    assert exit_code(summary()) == 0
    assert exit_code(summary(costs={"none": [4, 4], "lqt": [2, 5], "adapted": [1, 4.5]})) == 3
    # No control itself, to the bit, is no worse; nor is a law that is not known to the last number.
    assert exit_code(summary(costs={"none": [4, 4], "lqt": [2, 5], "adapted": [1, 4]})) == 0
    assert exit_code(summary(costs={"none": [4, 4], "lqt": [2, 5], "adapted": [1, np.nan]})) == 3
    lost = {"none": 0, "lqt": 0, "adapted": 4}
    assert (
        exit_code(summary(diverged=lost, costs={**summary()["costs"], "adapted": [1e9, 1e9]})) == 1
    )


def test_why_an_adaptation_did_not_help_is_said():
    outcome = [
        {"verdict": "the first law", "reason": "no other law is better"},
        {"verdict": "better", "reason": "better by more than chance"},
    ]
    lines = closing_lines("kdv", summary(changed=[False, True], outcome=outcome), "")
    assert lines[-1] == "  seed 0: no other law is better"
    alone = summary(
        seeds=1,
        changed=[False],
        outcome=outcome[:1],
        costs={"none": [4], "lqt": [2], "adapted": [2]},
    )
    assert closing_lines("kdv", alone, "")[-1] == "  the optimiser says: no other law is better"
    assert not any("more than chance" in line for line in lines)


@pytest.mark.parametrize(
    ("diverged", "adapted", "fails", "count"),
    [
        ({"none": 0, "lqt": 4, "adapted": 4}, [1e9, 1e9], True, 2),
        ({"none": 0, "lqt": 4, "adapted": 0}, [5.0, 5.0], True, 2),
        ({"none": 0, "lqt": 4, "adapted": 0}, [1.0, 1.0], False, 1),
        ({"none": 0, "lqt": 0, "adapted": 4}, [1e9, 1e9], True, 1),
        ({"none": 0, "lqt": 0, "adapted": 1}, [1e8, 1.0], False, 1),
    ],
)
def test_laws_that_diverge_are_told_with_likely_causes(diverged, adapted, fails, count):
    lqt = [1e9, 1e9] if diverged["lqt"] else [2.0, 3.0]
    costs = {"none": [4.0, 4.0], "lqt": lqt, "adapted": adapted}
    found = summary(costs=costs, diverged=diverged)
    assert failed(found) == fails
    assert len(warnings(found)) == count
    if diverged["lqt"]:
        assert "every rollout of the first laws diverged; likely causes: " in warnings(found)[0]
    assert not any("e+0" in line for line in closing_lines("p", found, ""))


def test_a_training_whose_laws_all_diverge_ends_with_a_warning_and_a_code(tmp_path, capsys):
    values = parameters(rollouts=11)
    training, pair = build_training(values), LocalPair(values)
    training.finish(pair.run(training.next_batch()))
    wild = training.models.copy()
    wild[:, -2 * values["n_a"] - 1 : -1] *= -1e6  # the gains
    np.savez(tmp_path / "model.npz", model=wild)
    words = ["--rollouts", "2", "--in-process", "--model", str(tmp_path / "model.npz")]
    assert main(["train", str(SMALL), *words, "--out", str(tmp_path / "run")]) == 1
    shown = capsys.readouterr().out
    assert "WARNING: every rollout of the first laws diverged; likely causes" in shown
    assert "e+0" not in shown
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["diverged"]["lqt"] == result["evaluation_rollouts"]


def test_how_much_an_adaptation_gained_is_said_with_its_interval() -> None:
    gained = {"change": -1.0, "low": -1.5, "high": -0.5, "fields": 10}
    chance = {"change": -0.1, "low": -0.5, "high": 0.3, "fields": 10}
    own = {"verdict": "better", "reason": ""}
    alone = summary(
        seeds=1,
        changed=[True],
        outcome=[own | {"against_lqt": gained}],
        costs={"none": [4], "lqt": [2], "adapted": [1]},
    )
    said = "  adapted minus LQT on the same 10 fields: -1 (95 % interval -1.5 to -0.5)"
    assert said in closing_lines("kdv", alone, "")
    outcome = [own | {"against_lqt": gained}, own | {"against_lqt": chance}]
    lines = closing_lines("kdv", summary(changed=[True, True], outcome=outcome), "")
    assert any("costs less than the LQT law for 1 of 2 seeds, more for 0" in line for line in lines)


def test_rollouts_that_were_not_used_are_said_with_the_reason_even_of_a_better_law() -> None:
    why = "9 of 20 rollouts were not used: more fields would not change the law"
    own = {"verdict": "better", "reason": "it is better", "early": why}
    lines = closing_lines("kdv", summary(seeds=1, changed=[True], outcome=[own]), "")
    assert f"  {why}" in lines and not any("it is better" in line for line in lines)
    outcome = [own | {"early": ""}, own]
    lines = closing_lines("kdv", summary(changed=[True, True], outcome=outcome), "")
    assert f"  seed 1: {why}" in lines


def test_a_rollout_that_diverged_is_compared_with_nothing() -> None:
    """Its cost is a penalty, and so would the difference and its interval be."""
    values = parameters(rollouts=8, optimizer="two_point")
    training = build_training(values)
    train(training, LocalPair(values), lambda row: None)
    assert training.ended is not None and training.evaluation is not None
    assert summarise(training)["outcome"][0]["against_lqt"] is not None
    for name in ("lqt", "adapted"):
        i = EVALUATED.index(name)
        before = training.ended[0, i, 0]
        training.ended[0, i, 0] = 7  # the step at which it did
        assert summarise(training)["outcome"][0]["against_lqt"] is None
        training.ended[0, i, 0] = before


def test_every_optimiser_that_leaves_rollouts_over_says_so_in_the_results() -> None:
    """One explores and two check: the paper's method steps with pairs of the five that are left."""
    values = parameters(rollouts=8, optimizer="two_point")
    training = build_training(values)
    train(training, LocalPair(values), lambda row: None)
    (own,) = summarise(training)["outcome"]
    total, spent = training.budget.total[0], training.budget.paid[0]
    assert spent == total - 1
    assert own["early"] == (
        f"1 of {total} rollouts was not used: the optimiser asked for no more, as its step takes 2"
    )


def test_the_interval_of_a_difference_has_the_mean_as_often_as_it_says() -> None:
    rng, inside = np.random.default_rng(5), 0
    for _ in range(1000):
        before = rng.standard_normal(10)  # common to both laws, so that it does not count
        found = difference(before, before - 0.3 + 0.1 * rng.standard_normal(10))
        assert found is not None
        inside += found["low"] <= -0.3 <= found["high"]
    assert 0.95 - 3 * 0.007 < inside / 1000 < 0.95 + 3 * 0.007
    assert difference([1.0], [2.0]) is None


@pytest.mark.parametrize(
    ("declared", "found", "said"),
    [
        (0.0, [0.0498], "noise of about 0.05 was found, and none was declared"),
        (0.15, [0.05], "noise of about 0.05 was found, and 0.15 was declared"),
        (
            0.0,
            [0.05, 0.0, 0.06],
            "noise of about 0.05 to 0.06 was found for 2 of 3 seeds, and none",
        ),
    ],
)
def test_noise_that_was_not_declared_so_is_a_warning(
    declared: float, found: list[float], said: str
) -> None:
    noise = {"declared": declared, "found": found}
    (text,) = misjudged_noise({"noise": noise, "seeds": len(found)})
    assert said in text
    assert ("explored too weakly" in text) == (max(found) > declared)
    assert misjudged_noise({"noise": {"declared": declared, "found": [0.0]}, "seeds": 1}) == []
    assert misjudged_noise({"seeds": 1}) == []  # a result of an older version


@pytest.mark.parametrize(
    ("declared", "seeming", "said"),
    [
        (0.0, [0.0498], "noise of about 0.05, and none was declared"),
        (0.15, [0.05], "noise of at most 0.05, and 0.15 was declared"),
        (0.01, [0.0, 0.05], "noise of about 0.05 for 1 of 2 seeds, and 0.01 was declared"),
    ],
)
def test_readings_that_seem_noisy_are_a_warning_with_a_remedy(
    declared: float, seeming: list[float], said: str
) -> None:
    noise = {"declared": declared, "found": [0.0] * len(seeming), "seeming": seeming}
    (text,) = misjudged_noise({"noise": noise, "seeds": len(seeming)})
    assert said in text and "set measurement_noise" in text
