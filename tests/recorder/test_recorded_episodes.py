# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Episodes in a bag: what belongs to which, when one is over, and what is said of contradictions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdeloop.bags.reader import Bag
from pdeloop.bags.verify import Report, verify
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import ACTION, COST, MODEL, POLICY, START, STATE, TARGET, VOID, Topic
from recorder_node.recording import Recording
from tests.support.written_bag import BY_TOPIC, RUN, SECOND, WHAT, encode, frame, recorded_episode

ROWS = np.array([(3.0, 4.0, 0.1, 0.0)])
ENDED = Frame(RUN, 7, 5, 0.0, np.array([(1.0, 5.0, -1.0)]), 99)


def bag_of(
    folder: Path, *messages: tuple[float, Topic, Frame], episodes: tuple[int, ...] = ()
) -> Bag:
    """A bag of messages with their times (s), after whole episodes, each at the time of its number."""
    recording = Recording(folder / "bag", WHAT)
    for number in episodes:
        recorded_episode(recording, number)
    for when, topic, content in messages:
        recording.take(BY_TOPIC[topic], int(when * SECOND), encode(topic, content))
    recording.close()
    return Bag(folder / "bag")


OTHERS = {
    STATE: replace(frame(3, 1, 16), values=np.zeros((1, 16))),
    ACTION: replace(frame(3, 1, 4), values=np.zeros((1, 4))),
    START: Frame(RUN, 7, 0, 0.0, ROWS + 1.0),
    COST: replace(ENDED, values=2.0 * ENDED.values),
}


@pytest.mark.parametrize("topic", OTHERS, ids=lambda topic: topic.name)
def test_what_was_recorded_twice_with_different_values_is_a_difference(tmp_path, topic):
    bag = bag_of(tmp_path, (7.1, topic, OTHERS[topic]), episodes=(7,))
    (found,) = bag.episodes()
    (text,) = found.contradictions
    assert topic.name in text
    assert [text in told for told in verify(bag.path).differences] == [True]


def test_the_same_twice_is_no_difference(tmp_path):
    (found,) = bag_of(tmp_path, (7.1, STATE, frame(3, 1, 16)), episodes=(7,)).episodes()
    assert found.contradictions == []


@pytest.mark.parametrize("environment", [0, 1])
def test_an_episode_of_which_one_environment_is_void_is_void(tmp_path, environment):
    cost = replace(ENDED, values=np.repeat(ENDED.values, 2, axis=0))
    cost.values[environment, -1] = VOID
    start = Frame(RUN, 7, 0, 0.0, np.repeat(ROWS, 2, axis=0))
    (found,) = bag_of(tmp_path, (1.0, START, start), (1.1, COST, cost)).episodes()
    assert found.void


def test_the_models_of_an_episode_are_those_with_the_number_of_its_start(tmp_path):
    known = [(1.0, MODEL, Frame(RUN, 0, n, 0.0, np.full((1, 9, 2), float(n)))) for n in (1, 2, 3)]
    numbers = {7: 2, 8: 3, 9: 1}
    for episode, number in numbers.items():
        rows = np.array([(3.0, -1.0, 0.0, 0.0)])
        known += [
            (2.0, POLICY, Frame(RUN, episode, number, 0.0, np.ones((1, 2, 4)))),
            (2.0, START, Frame(RUN, episode, number, 0.0, rows)),
            (2.0, COST, replace(ENDED, episode=episode)),
        ]
    found = {e.number: e.bases for e in bag_of(tmp_path, *known).episodes()}
    assert {number: bases.step for number, bases in found.items() if bases} == numbers


def test_a_late_message_of_an_episode_that_is_over_makes_no_second_one(tmp_path):
    bag = bag_of(tmp_path, (31.0, STATE, frame(3, 1, 16)), episodes=(7, 8, 30))
    assert [episode.number for episode in bag.episodes()] == [7, 8, 30]


def test_the_last_episode_is_waited_for_however_long_its_plant_is_paused(tmp_path):
    messages = [(1.0, START, Frame(RUN, 7, 0, 0.0, ROWS))]
    for step in range(6):
        at = 60.0 * (step + 1)
        messages += [(at, STATE, frame(step, 1, 16)), (at, ACTION, frame(step, 1, 4))]
        messages.append((at + 50.0, TARGET, Frame(0, 0, 0, 0.0, np.ones(16), 99)))
    (found,) = bag_of(tmp_path, *messages, (400.0, COST, ENDED)).episodes()
    assert found.missing == []


@pytest.mark.parametrize("shape", [(1, 3), (3, 3), (2, 2), (2, 4)])
def test_another_shape_is_a_difference(shape):
    report = Report("a bag")
    assert not report.compare("costs", "cost of episode 7", np.zeros((2, 3)), np.zeros(shape))
    assert report.count == 1 and "recorded shape (2, 3)" in report.differences[0]
