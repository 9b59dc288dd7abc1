# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Of what a result warns, with likely causes, and which exit code it has."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pdeloop.cli import main
from pdeloop.in_process import LocalPair
from tests.support.small import SMALL, parameters
from tests.support.training_summary import summary
from tuner_node.build import build_training
from tuner_node.narration import IDLE, closing_lines, exit_code, failed, misjudged_noise, warnings


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


def test_a_rollout_that_costs_otherwise_at_the_end_is_a_plant_that_does_not_repeat():
    pairs = [{"then": 2.0, "now": 2.0}, None, {"then": 2.0, "now": 2.1}, {"then": 2.0, "now": 2.01}]
    (told,) = warnings(summary(repeated=pairs))
    assert "initial field cost 2, and 2.1 when it ran again at the end (+5 %)" in told
    assert "it drifts" in told and "a difference in cost of that size is no gain" in told
    assert warnings(summary(repeated=[{"then": 0.0, "now": 0.0}, {"then": 2.0, "now": 2.0}])) == []
    assert (
        "cost 0, and 1 when it ran again at the end: the"
        in warnings(summary(repeated=[{"then": 0.0, "now": 1.0}]))[0]
    )


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


@pytest.mark.parametrize(
    ("declared", "found", "said"),
    [
        (0.0, [0.0498], "noise of about 0.05 was found, but none was declared"),
        (0.15, [0.05], "noise of about 0.05 was found, but 0.15 was declared"),
        (
            0.0,
            [0.05, 0.0, 0.06],
            "noise of about 0.05 to 0.06 was found for 2 of 3 seeds, but none",
        ),
    ],
)
def test_noise_that_was_not_declared_so_is_a_warning(
    declared: float, found: list[float], said: str
) -> None:
    noise = {"declared": declared, "found": found}
    (text,) = misjudged_noise({"noise": noise, "seeds": len(found)})
    assert said in text
    assert ("its exploration was too weak" in text) == (max(found) > declared)
    assert misjudged_noise({"noise": {"declared": declared, "found": [0.0]}, "seeds": 1}) == []
    assert misjudged_noise({"seeds": 1}) == []  # a result of an older version


@pytest.mark.parametrize(
    ("declared", "seeming", "said"),
    [
        (0.0, [0.0498], "noise of about 0.05, but none was declared"),
        (0.15, [0.05], "noise of at most 0.05, but 0.15 was declared"),
        (0.01, [0.0, 0.05], "noise of about 0.05 for 1 of 2 seeds, but 0.01 was declared"),
    ],
)
def test_readings_that_seem_noisy_are_a_warning_with_a_remedy(
    declared: float, seeming: list[float], said: str
) -> None:
    noise = {"declared": declared, "found": [0.0] * len(seeming), "seeming": seeming}
    (text,) = misjudged_noise({"noise": noise, "seeds": len(seeming)})
    assert said in text and "set measurement_noise" in text
