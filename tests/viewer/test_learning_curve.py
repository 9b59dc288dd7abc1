# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The learning curve of a page follows from a training's events, or from the topics alone."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from pdeloop.messages.topics import COMPLETED, VOID
from tests.support.viewed import cost, frame, start
from viewer_node.learning_curve import MAX_POINTS, SENT, LearningCurve
from viewer_node.loop_view import LoopView
from viewer_node.rollout_costs import RolloutCosts


def adapted(seed: int, rollouts: int, cost: float | None, **more: Any) -> dict[str, Any]:
    known = {} if cost is None else {"cost": cost}
    return {"event": "adapted", "seed": seed, "rollouts": rollouts, "diverged": 0} | known | more


def points(curve: LearningCurve) -> list[tuple[float, ...]]:
    """What a page is sent: x, mean, low, high."""
    sent = curve.message()
    json.dumps(sent, allow_nan=False)
    return list(zip(*(sent[name] for name in ("x", "mean", "low", "high")), strict=True))


def test_the_band_of_several_seeds_is_over_the_seeds_and_of_one_over_its_rollouts():
    several, one = LearningCurve(), LearningCurve()
    for seed, value in enumerate((1.0, 2.0, 6.0)):
        several.row(adapted(seed, 2, value, cost_plus=value + 9, cost_minus=value - 9))
    one.row(adapted(0, 2, 2.0, cost_plus=2.5, cost_minus=1.5))
    assert points(several) == [(2, 3.0, 1.0, 6.0)] and several.message()["band"] == "seeds"
    assert points(one) == [(2, 2.0, 1.5, 2.5)] and one.message()["band"] == "rollouts"


def test_seeds_that_are_at_other_rollouts_keep_their_cost_until_their_next_point():
    curve = LearningCurve()
    for seed, rollouts, value in ((0, 3, 4.0), (1, 4, 2.0), (0, 5, 3.0), (1, 9, 1.0)):
        curve.row(adapted(seed, rollouts, value))
    assert points(curve) == [(3, 4, 4, 4), (4, 3, 2, 4), (5, 2.5, 2, 3), (9, 2, 1, 3)]
    assert curve.message()["costs"] == [[4, 4, 3, 3], [None, 2, 2, 1]]
    curve.row(adapted(0, 5, 3.5))  # a tuner that was killed repeats what it had not kept
    assert points(curve)[2] == (5, 2.75, 2, 3.5)


def test_what_diverged_has_no_point_and_broken_lines_are_left_out():
    curve = LearningCurve()
    curve.row(adapted(0, 2, None, diverged=2))
    for line in ({}, {"event": "adapted"}, {"event": "adapted", "seed": "x", "rollouts": 1}):
        curve.row(line)
    assert (
        points(curve) == []
        and curve.message()["diverged"] == 2
        and curve.message()["paid"] == [2, 2]
    )


def test_references_are_those_of_the_evaluation_alone_as_all_others_are_on_other_fields():
    curve = LearningCurve()
    curve.row({"event": "checked", "seed": 0, "none": 9.0, "lqt": 99.0, "accepted": False})
    assert curve.references == {}
    for seed, lqt in ((0, 2.0), (1, 4.0)):
        curve.row({"event": "checked", "seed": seed, "none": 9.0, "lqt": lqt, "accepted": True})
    assert curve.references == {} and curve.checked == {"none": 9.0, "lqt": 3.0}
    curve.row({"event": "evaluated", "seed": 0, "none": 8.0, "lqt": 2.5, "adapted": 1.5})
    assert curve.references == {"none": 8.0, "lqt": 2.5, "adapted": 1.5}
    assert curve.evaluations == {0: {"none": 8.0, "lqt": 2.5, "adapted": 1.5}}


def test_a_long_training_stays_within_bounds():
    curve = LearningCurve()
    for k in range(1, 3 * MAX_POINTS):
        curve.row(adapted(0, k, 1.0))
    xs = curve.message()["x"]
    assert len(xs) <= SENT and xs[-1] == 3 * MAX_POINTS - 1
    assert len(curve._points[0]) <= MAX_POINTS


def test_the_time_that_is_left_follows_from_the_rollouts_of_the_last_minute():
    curve = LearningCurve()
    assert curve.remaining(0.0) is None
    for seed in (0, 1):
        curve.row({"event": "designed", "seed": seed})
    # One seed was explored more often: what it has paid before is no speed.
    paid = {"budget": [100, 100], "rollouts": [0, 50], "time": 0.0}
    curve.row({"event": "phase", "phase": "adapt", **paid})
    assert curve.message()["paid"] == [0, 50] and curve.seeds == [0, 1]
    for k in range(1, 31):  # ten seconds each at first, then one
        now = 10.0 * min(k, 10) + max(0, k - 10)
        curve.row(adapted(0, k, 1.0, time=now))
        curve.row(adapted(1, 50 + k, 1.0, time=now))
    rate = 2 * (30 - 6) / 60.0
    assert curve.remaining(120.0) == pytest.approx((70 + 20) / rate, rel=0.05)
    assert curve.remaining(130.0) == pytest.approx(curve.remaining(120.0) - 10.0)
    assert curve.remaining(1e4) is None  # nothing has come for longer than that
    curve.row({"event": "phase", "phase": "evaluate", **paid})
    assert curve.remaining(130.0) is None


def test_from_the_topics_alone_policies_are_points_and_all_three_controllers_an_evaluation():
    curve, costs = LearningCurve(), RolloutCosts()
    acts = [[3, -1, 0, 0], [3, -1, 0, 0], [4, -1, 0, 1], [4, -1, 0, 1]]

    def episode(rows: Any, gains: Any, means: list[float], ended: int = COMPLETED) -> None:
        costs.start(start(rows))
        costs.policy(frame(gains))
        curve.episode(costs.cost(cost(means, ended=ended)))

    gains = np.ones((4, 2, 3))
    episode(acts, gains, [1.0, 3.0, 5.0, 7.0])
    assert points(curve) == [(1, 4.0, 2.0, 6.0)]
    gains = gains.copy()
    gains[:2] = 0.0
    episode(acts, gains, [8.0, 10.0, 1.0, 1.0])
    assert curve.references == {} and len(points(curve)) == 1  # LQT's law is not known
    episode([[3, 17, 0.1, 0]], gains, [50.0])
    assert points(curve)[1:] == [(2, 28.0, 6.0, 50.0)] and curve.phase == "identify"
    episode(acts, np.ones((4, 2, 3)), [1e9, 1e9, 2.0, 2.0], ended=12)
    assert len(points(curve)) == 2 and curve.message()["diverged"] == 4


def test_episodes_that_come_in_at_once_are_a_point_each():
    view = LoopView()
    for episode in (1, 2, 3):
        view.policy(frame(np.ones((2, 2, 3)), episode=episode), 1.0)
    for episode in (1, 2, 3):
        view.start(start([[3, -1, 0, 0], [4, -1, 0, 0]], episode=episode), 1.0)
    view.start(frame(np.empty((0, 4)), episode=0), 1.0)
    for episode in (1, 2, 3):
        view.cost(cost([episode, episode + 2.0], episode=episode), 1.0)
    three = [(1, 2.0), (2, 3.0), (3, 4.0)]
    assert [point[:2] for point in points(view.curve)] == three
    view.cost(cost([9.0, 9.0], episode=4), 1.0)  # nobody knows what it was
    view.start(start([[3, -1, 0, 0]], episode=5), 1.0)
    view.policy(frame(np.ones((1, 2, 3)), episode=5), 1.0)
    view.cost(cost([9.0], episode=5, ended=VOID), 1.0)
    assert len(points(view.curve)) == 3


def test_the_curve_begins_with_the_first_rollout_and_says_whether_a_law_was_measured():
    curve = LearningCurve()
    told = {"event": "measured", "seed": 0, "diverged": 0}
    curve.row({**told, "phase": "identify", "rollouts": 2, "cost": 9, "lowest": 8, "highest": 10})
    assert points(curve) == [(2, 9, 8, 10)] and not curve.message()["laws"]
    curve.row({**told, "phase": "adapt", "rollouts": 6, "cost": 4, "lowest": 3, "highest": 5})
    curve.row({**told, "phase": "adapt", "rollouts": 8, "diverged": 2})
    assert points(curve)[1:] == [(6, 4, 3, 5)] and curve.message()["laws"]
    curve.row(adapted(0, 6, 4.5))  # what the optimiser makes of the same rollouts
    assert points(curve)[1:] == [(6, 4.5, 4.5, 4.5)]
