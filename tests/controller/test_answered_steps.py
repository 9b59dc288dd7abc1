# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A cost that says an episode went further than the plant got, once the plant has said it too."""

from __future__ import annotations

import numpy as np
import pytest

from controller_node.run_state import AnsweredSteps
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import COMPLETED, VOID

RUN, PLANT = 5, 9


def cost(step: int, *, episode: int = 1, void: bool = False) -> Frame:
    rows = np.array([[1.0, 30.0, COMPLETED], [1.0, 30.0, VOID if void else COMPLETED]])
    return Frame(RUN, episode, step, 0.0, rows, PLANT)


def answered(to: int, episode: int = 1) -> AnsweredSteps:
    steps = AnsweredSteps()
    for step in range(to + 1):
        steps.answered((RUN, PLANT, episode), step)
    return steps


@pytest.mark.parametrize("furthest", [0, 1, 7])
def test_a_cost_beyond_the_answered_steps_contradicts_a_void_one_before_it_once(
    furthest: int,
) -> None:
    steps = answered(furthest)
    assert not steps.contradiction(cost(furthest + 1))
    said = steps.contradiction(cost(furthest, void=True))
    assert f"reached step {furthest + 1}" in said and f"gave it up at step {furthest}" in said
    assert not steps.contradiction(cost(furthest, void=True))


def test_a_cost_of_what_was_answered_contradicts_nothing() -> None:
    steps = answered(7)
    assert not steps.contradiction(cost(7))
    assert not steps.contradiction(cost(6, void=True))


def test_a_void_cost_where_the_other_one_ended_contradicts_nothing() -> None:
    steps = answered(7)
    steps.contradiction(cost(9))
    assert not steps.contradiction(cost(9, void=True))
    assert steps.contradiction(cost(8, void=True))


def test_a_claim_is_dropped_by_answers_of_its_own_episode_up_to_there_alone() -> None:
    steps = answered(7)
    steps.contradiction(cost(9))
    steps.answered((RUN, PLANT, 1), 8)
    steps.answered((RUN, PLANT, 2), 12)
    assert steps.contradiction(cost(8, void=True))
    steps = answered(7)
    steps.contradiction(cost(9))
    steps.answered((RUN, PLANT, 1), 9)
    assert not steps.contradiction(cost(8, void=True))


@pytest.mark.parametrize("other", [(RUN + 1, PLANT, 1), (RUN, PLANT + 1, 1), (RUN, PLANT, 2)])
def test_an_episode_of_another_run_plant_or_number_is_another(other: tuple[int, int, int]) -> None:
    steps = answered(7)
    steps.answered(other, 3)  # not from its first step on
    run, plant, episode = other
    far = Frame(run, episode, 9, 0.0, cost(9).values, plant)
    assert not steps.contradiction(far)
    assert not steps.contradiction(cost(3, void=True))
