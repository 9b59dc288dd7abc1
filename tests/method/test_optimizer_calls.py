# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What an optimiser of one's own raises or returns ends a training with one sentence."""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
import pytest

from pdeloop.messages.own_code import OwnCodeError
from pdeloop.method.adapt import Rollout, RolloutResult, StepOptimizer, registry
from pdeloop.method.adapt.two_point import TwoPoint, TwoPointSettings

POLICY = np.zeros((2, 3))
SIZE = POLICY.size


class Own(StepOptimizer):
    """Takes one rollout a step; `faulty` is done by the method of that name."""

    name = "own"
    step_rollouts = 1

    def __init__(self, **faulty: Any) -> None:
        super().__init__(POLICY, seed=0, rollouts=3, settings=None)
        self.faulty = faulty

    def rollouts(self) -> Any:
        return self.faulty["rollouts"]() if "rollouts" in self.faulty else [Rollout(POLICY, 1)]

    def update(self, results: Any) -> Any:
        return self.faulty["update"]() if "update" in self.faulty else {}


def asks(policy: Any) -> Own:
    return Own(rollouts=lambda: [Rollout(policy, 1)])


def test_rollouts_and_reports_go_through_as_they_are() -> None:
    (asked,) = registry.ask(Own(), SIZE)
    assert asked.policy is POLICY and asked.field_seed == 1
    (flat,) = registry.ask(asks(POLICY.ravel()), SIZE)
    assert flat.policy.shape == (SIZE,)
    assert registry.tell(Own(update=lambda: {"own": 2.0}), [RolloutResult(1.0)])["own"] == 2.0


def test_the_row_of_a_step_has_the_mean_cost_of_what_did_not_diverge_unless_told() -> None:
    class Two(Own):
        step_rollouts = 2

    good, lost = RolloutResult(3.0), RolloutResult(1e9, diverged=True)
    assert Two().tell([good, RolloutResult(1.0)])["cost"] == 2.0
    assert Two().tell([good, lost])["cost"] == 3.0
    assert "cost" not in Two().tell([lost, lost])
    assert Two(update=lambda: {"cost": 7.0}).tell([good, good])["cost"] == 7.0


@pytest.mark.parametrize(
    ("optimizer", "words"),
    [
        (
            Own(rollouts=lambda: 1 / 0),
            r"Own.ask fails: .*test_optimizer_calls.py, line \d+: ZeroDiv",
        ),
        (Own(rollouts=sys.exit), r"Own.ask fails: .*test_optimizer_calls.py, line \d+: SystemExit"),
        (Own(rollouts=lambda: 3), "Own.ask returned int; expected a list of Rollout"),
        (Own(rollouts=lambda: [3.0]), "Own.ask returned a list with float; expected a list"),
        (asks("gains"), "Own.ask: a policy is str, which is not an array of real numbers"),
        (asks(POLICY[:1]), r"a policy is an array of shape \(1, 3\); expected 6 finite numbers"),
        (asks(POLICY + np.nan), "a policy is NaN or infinity; expected 6 finite numbers"),
    ],
)
def test_what_it_asks_for_is_checked(optimizer: Own, words: str) -> None:
    with pytest.raises(OwnCodeError, match=words):
        registry.ask(optimizer, SIZE)


@pytest.mark.parametrize(
    ("update", "words"),
    [
        (lambda: [][0], r"Own.tell fails: .*test_optimizer_calls.py, line \d+: IndexError"),
        (
            lambda: sys.exit(0),
            r"Own.tell fails: .*test_optimizer_calls.py, line \d+: SystemExit: 0",
        ),
        (lambda: 7, "Own.update returned int; expected a dict"),
        (lambda: {"own": object()}, "Own.tell returned object as 'own'; expected a text as key"),
        (lambda: {"own": [object()]}, "Own.tell returned list as 'own'"),
        (lambda: {3: 1.0}, "Own.tell returned float as 3"),
        (lambda: {"cost": "low"}, "Own.tell returned str as 'cost'; expected a number"),
        (lambda: {"diverged": {}}, "Own.tell returned dict as 'diverged'; expected a number"),
    ],
)
def test_what_it_reports_is_checked(update: Any, words: str) -> None:
    with pytest.raises(OwnCodeError, match=words):
        registry.tell(Own(update=update), [RolloutResult(1.0)])


def test_a_report_may_hold_what_numpy_computes_and_is_kept_as_json() -> None:
    def report() -> dict[str, Any]:
        best = np.array([2.0, 1.0])
        return {
            "updated": best[1] < best[0],
            "index": best.argmin(),
            "best": best,
            "cost": best.min(),
            "lost": np.inf,
        }

    row = registry.tell(Own(update=report), [RolloutResult(1.0)])
    assert json.loads(json.dumps(row)) == row
    expected = {"updated": True, "index": 1, "best": [2.0, 1.0], "cost": 1.0}
    assert row == {"rollouts": 1, "diverged": 0} | expected


@pytest.mark.parametrize("count", [1, 3])
def test_a_step_that_asks_for_other_than_its_rollouts_is_told_so(count: int) -> None:
    class Two(Own):
        step_rollouts = 2

    asking = Two(rollouts=lambda: [Rollout(POLICY, 1)] * count)
    with pytest.raises(OwnCodeError, match=f"Two.rollouts returned {count}; .* which is 2"):
        registry.ask(asking, SIZE)


def test_a_shipped_optimizer_says_itself_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="result"):
        registry.tell(
            TwoPoint(POLICY, seed=0, rollouts=4, settings=TwoPointSettings(learning_rate=0.1)), []
        )
