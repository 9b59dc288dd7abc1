# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The last rollouts of `gauss_newton` where rollouts alone decide."""

from __future__ import annotations

import numpy as np
import pytest

from loop_interfaces.arrays import Array
from loop_method.adapt import Context, Trajectory
from loop_method.adapt.base import Record
from loop_method.adapt.final_comparison import Comparison, on_same_fields
from loop_method.adapt.settings import ImprovementSettings
from loop_method.adapt.verdict import ADAPTED, ALL_AGREE, FIRST, NONE, Verdict

POINTS = np.zeros((3, 2))
ACTED = np.zeros((2, 1))
CONTEXT = Context(np.eye(2), np.zeros(2), 1.0, 1.0, 2, Trajectory(POINTS, ACTED))
LAWS = {FIRST: np.full((1, 4), 2.0), ADAPTED: np.ones((1, 4)), NONE: np.zeros((1, 4))}
SETTINGS = ImprovementSettings()


def ran(law: str, *costs: float, stamp: int = 0) -> list[Record]:
    return [Record(LAWS[law], cost, POINTS, ACTED, stamp) for cost in costs]


def verdict(comparison: Comparison, known: list[Record], costs: dict[str, Array]) -> Verdict:
    """Of costs on fresh fields, in the order in which they are asked for."""
    left = {name: iter(own) for name, own in costs.items()}
    fresh = [record for name in comparison.names for record in ran(name, next(left[name]))]
    return comparison.verdict(CONTEXT, LAWS, known, fresh, 1.0)


@pytest.mark.parametrize("left", [4, 5, 6, 7])
def test_every_rollout_that_is_left_tells_a_law_from_no_control(left: int) -> None:
    """An odd one is spent on no control, on a field of its own."""
    found = on_same_fields(LAWS, NONE, False, range(left), SETTINGS)
    own, none = (
        [field for name, field in zip(found.names, found.numbers, strict=True) if name == law]
        for law in (ADAPTED, NONE)
    )
    assert own == none[: len(own)] == list(range(left // 2))
    assert none == list(range(left - left // 2))


def test_against_the_first_law_pairs_decide() -> None:
    found = on_same_fields(LAWS, FIRST, False, range(7), SETTINGS)
    assert found.names == [FIRST] * 3 + [ADAPTED] * 3
    costs = {FIRST: np.array([34.0, 47.0, 103.0]), ADAPTED: np.array([55.0, 52.0, 48.0])}
    known = ran(FIRST, 47.0, 93.0, 113.0) + ran(ADAPTED, 51.0, 42.0, 43.0)
    assert verdict(found, known, costs).chosen == FIRST


def test_no_control_is_judged_by_all_of_its_rollouts() -> None:
    found = on_same_fields(LAWS, NONE, False, range(7), SETTINGS)
    costs = {NONE: np.array([34.0, 47.0, 103.0, 60.0]), ADAPTED: np.array([55.0, 52.0, 48.0])}
    known = ran(NONE, 47.0, 93.0, 113.0)
    chosen = verdict(found, known, costs)
    every = np.append(costs[NONE], [47.0, 93.0, 113.0])
    assert chosen.chosen == ADAPTED and ALL_AGREE not in chosen.reason
    assert chosen.change == pytest.approx(costs[ADAPTED].mean() - every.mean())
    costs[NONE][2:] = 93.0, 52.0  # a difference that chance explains
    few = verdict(found, [], costs)
    assert few.chosen == NONE, "rollouts alone favour it, and they may by chance"
    steps = ran(NONE, 47.0, 30.0, 60.0) + ran(ADAPTED, 40.0, 42.0, 43.0)
    assert ALL_AGREE in verdict(found, steps, costs).reason
    assert verdict(found, ran(NONE, 47.0, 30.0) + ran(ADAPTED, 70.0, 72.0), costs).chosen == NONE


def test_an_exploration_is_no_rollout_of_no_control_that_diverged() -> None:
    """Its actions are not those of any law, and it has no cost."""
    found = on_same_fields(LAWS, NONE, False, range(3), SETTINGS)
    assert found.names == [ADAPTED] * 3
    explored = ran(NONE, np.inf, stamp=-1)
    worse = {ADAPTED: np.array([90.0, 91.0, 92.0])}
    kept = verdict(found, explored + ran(NONE, 50.0, 51.0), worse)
    assert kept.chosen == NONE and "diverged" not in kept.reason
    steps = ran(NONE, 50.0, 90.0) + ran(ADAPTED, 60.0, 61.0)
    close = {ADAPTED: np.array([66.0, 68.0, 65.0])}
    assert ALL_AGREE in verdict(found, explored + steps, close).reason
