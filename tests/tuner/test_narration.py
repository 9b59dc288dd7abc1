# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a person is told of a training."""

from __future__ import annotations

import io
from typing import Any

import pytest

from pdeloop.display import Display
from pdeloop.in_process import LocalPair
from pdeloop.method.adapt.replay import ALONG
from tests.support.small import parameters
from tests.support.training_summary import summary
from tuner_node.build import build_training
from tuner_node.narration import Narration, closing_lines, failed, warnings
from tuner_node.rollouts import CHECK


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
        "  seed 3: a rollout costs 5 without control, diverged with LQT; "
        "LQT is no better, exploring again",
        "  seed 3: a rollout costs 5 without control, 9 with LQT; "
        "LQT is no better, and no exploration is left, so the warm start is poor",
        "adapt",
        "  20 rollouts: mean cost 1.25 of the laws tried last, not of the returned one",
        "evaluate",
    ]


def test_of_several_seeds_mean_and_range_are_told_in_one_line():
    rows = [phase("check", [1] * 3), checked(0, 2.0), checked(1, 9.0, again=True)]
    rows += [checked(2, 2.5e8, lost=1, again=True), phase("identify", [9] * 3)]
    assert told(rows, seeds=3)[1] == (
        "  3 seeds: a rollout costs 5 without control, 5.5 (2 to 9) and 1 diverged with LQT; "
        "LQT is no better for 2 of them, exploring again"
    )


def test_the_status_is_of_all_seeds_and_a_diverged_law_says_so():
    narration = Narration(4, 3)
    narration.lines(phase("adapt", [9, 9, 18]))
    assert (narration.done, narration.budget) == (36, 60)
    narration.lines(adapted(4, 11, None))
    assert (narration.done, narration.status) == (38, "the laws tried last diverged")
    narration.lines(adapted(5, 11, 1.0))
    narration.lines(adapted(6, 20, 3.0))
    told = "mean cost 2 (1 to 3) and 1 diverged of the laws tried last"
    assert (narration.done, narration.status) == (42, told)


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
    assert "and 1 diverged with LQT; LQT is no better for 1 of them" in shown
    assert "e+0" not in shown


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


def test_a_first_law_that_costs_more_than_no_control_is_told_with_what_is_returned():
    """Beyond chance, of each seed, though the returned law is better."""
    costs = {"none": [4.0, 4.0], "lqt": [5.0, 19.2], "adapted": [1.0, 2.0]}
    own = {"verdict": "better", "reason": ""}
    chance, sure = ({"change": 1.0, "low": low, "high": 9.0, "fields": 10} for low in (-1.0, 0.5))
    outcome = [own | {"lqt_against_none": chance}, own | {"lqt_against_none": sure}]
    told = closing_lines("kdv", summary(costs=costs, outcome=outcome), "")
    known = "the first law costs 4.8 times what no control does, the returned one 0.5 times"
    assert [line for line in told if "what no control does" in line] == [f"  seed 1: {known}"]
    alone = {name: own[1:] for name, own in costs.items()}
    told = closing_lines("kdv", summary(seeds=1, costs=alone, outcome=outcome[1:]), "")
    assert f"  {known}" in told


def test_a_plant_that_costs_nothing_without_control_has_no_share_of_that():
    costs = {"none": [0.0, 0.0], "lqt": [2.0, 3.0], "adapted": [1.0, 2.0]}
    assert "adaptation 1.5" in closing_lines("kdv", summary(costs=costs), "")[3]


def test_an_optimiser_that_tells_no_cost_has_not_diverged():
    narration = Narration(3, 1)
    narration.lines({"event": "phase", "phase": "adapt", "rollouts": [3], "budget": [20]})
    narration.lines({"event": "adapted", "seed": 3, "rollouts": 5})
    assert narration.progress == "  5 of 20 rollouts"
    narration.lines(adapted(3, 7, None))
    assert narration.progress == "  7 of 20 rollouts: the laws tried last diverged"


def test_what_adapted_nothing_is_no_gain():
    lines = closing_lines("kdv", summary(changed=[False, False]), "")
    assert not any("LQT;" in line or "% below" in line for line in lines)
    assert (
        "  nothing was adapted: the policies are those with which the adaptation started" in lines
    )


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


@pytest.mark.parametrize(("adapted", "said"), [(3.9, True), (3.7, False), (4.1, False)])
def test_a_law_that_saves_next_to_nothing_is_told_with_likely_causes(adapted, said):
    costs = {"none": [4.0], "lqt": [4.0], "adapted": [adapted]}
    lines = closing_lines("kdv", summary(seeds=1, changed=[True], costs=costs), "")
    assert (
        any(
            "control saves only 2.5 % of the cost without control; likely causes: actions" in t
            for t in lines
        )
        == said
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
    assert any(
        "costs less than the LQT law for 1 of 2 seeds and more for 0" in line for line in lines
    )


def test_a_law_that_costs_more_than_its_model_predicts_is_said() -> None:
    """With both costs, also where another law is returned, and of each seed alone."""
    judged = {"event": "adapted", "seed": 7, "role": "judging", "cost": 3044.0, "predicted": 303.0}
    right = judged | {"seed": 8, "predicted": 3000.0}
    own = {"verdict": "better", "reason": "it is better"}
    earlier = judged | {"role": "renewing", "predicted": 1.0}
    alone = summary(seed=7, seeds=1, changed=[True], outcome=[own], history=[earlier, judged])
    told = "of the last law the model predicts 303, the plant shows 3044 (rollouts are missed by"
    assert any(line.startswith(f"  {told}") for line in closing_lines("kdv", alone, ""))
    both = summary(seed=7, changed=[True, True], outcome=[own, own], history=[judged, right])
    lines = [line for line in closing_lines("kdv", both, "") if "the plant shows" in line]
    assert len(lines) == 1 and lines[0].startswith(f"  seed 7: {told}")
    single = {"cost": 28.61, "predicted": 23.46, "missed": 6.7}  # though the means differ by less
    alone = summary(seed=7, seeds=1, changed=[True], outcome=[own], history=[judged | single])
    told = "predicts 23.46, the plant shows 28.61 (rollouts are missed by 23 % of that)"
    assert any(told in line for line in closing_lines("kdv", alone, ""))
    fine = summary(seed=8, seeds=1, changed=[True], outcome=[own], history=[earlier, right])
    assert not any("the plant shows" in line for line in closing_lines("kdv", fine, ""))


def test_that_no_model_served_in_the_end_is_said() -> None:
    why = "no model of the whole field predicts the rollouts"
    row = {"event": "adapted", "seed": 7, "role": "renewing", "reason": f"{why}: {ALONG}"}
    own = {"verdict": "better", "reason": "it is better"}

    def told(*history: dict[str, Any]) -> list[str]:
        alone = summary(seed=7, seeds=1, changed=[True], outcome=[own], history=list(history))
        return [line for line in closing_lines("kdv", alone, "") if ALONG in line]

    (line,) = told(row)
    assert line.startswith(f"  {why}, so it was improved by {ALONG} alone: explore less far")
    modelled = {name: row[name] for name in ("event", "seed", "role")}
    assert told(row, modelled) == []


def test_rollouts_that_were_not_used_are_said_with_the_reason_even_of_a_better_law() -> None:
    why = "9 of 20 rollouts were not used: more fields would not change the law"
    own = {"verdict": "better", "reason": "it is better", "early": why}
    lines = closing_lines("kdv", summary(seeds=1, changed=[True], outcome=[own]), "")
    assert f"  {why}" in lines and not any("it is better" in line for line in lines)
    outcome = [own | {"early": ""}, own]
    lines = closing_lines("kdv", summary(changed=[True, True], outcome=outcome), "")
    assert f"  seed 1: {why}" in lines


def test_of_laws_that_plan_it_is_told_what_they_save_and_how_often_they_fall_back():
    acting = [{"law": "predictive", "first_step": 0.1, "step": n * 1e-3} for n in (2, 3)]
    acting.append({"law": "affine", "first_step": 1e-6, "step": 1e-6})
    history = [
        {"seed": m, "plan_saves": 0.1 * (m + 1), "plan_fallbacks": 0.02 * m} for m in range(2)
    ]
    outcome = [{"verdict": "better", "reason": "why", "early": ""}] * 3
    costs = {name: [cost] * 3 for name, cost in {"none": 4.0, "lqt": 2.0, "adapted": 1.0}.items()}
    given = {"changed": [True] * 3, "outcome": outcome, "history": history, "costs": costs}
    lines = closing_lines("kdv", summary(seeds=3, **given, acting=acting), "")
    assert (
        "  the law that acts is predictive for 2 of 3 seeds (on the model it saves 10 to 20 % of the "
        "cost of the law that it began as); a step takes 2 to 3 ms, the first one 1e+02 ms; at 0 "
        "to 2 % of steps on the model it fell back on that law's plan"
    ) in lines
    given = {"changed": [True], "outcome": outcome[:1], "history": history[:1]}
    (line,) = (
        line
        for line in closing_lines("kdv", summary(seeds=1, **given, acting=acting[:1]), "")
        if "the law that acts" in line
    )
    assert line.endswith("predictive (why); a step takes 2 ms, the first one 1e+02 ms")
