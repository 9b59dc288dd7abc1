# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The dispatcher and a plant that is paused, or told to end what is under way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdeloop.messages.frames import Frame, FrameError
from tests.support.dispatching import RUN, batch, costs_of, dispatcher, starts


def said(value: float, plant: int = 0) -> Frame:
    return Frame(RUN, 1, 3, 1.0, np.array([value]), plant)


def test_a_paused_plant_is_not_silent_as_long_as_it_says_so():
    served = dispatcher()
    ((_, start),) = starts(served.assign(batch(1), 0.0))
    for now in np.arange(1.0, 200.0, 1.0):  # an episode_timeout is 10 s
        served.plant_paused(0, said(1.0), now)
        for _, frame in starts(served.tick(now + 0.5)):
            assert frame.episode == start.episode  # asks again, which keeps the plant for this run
    assert served.paused_pairs(199.0) == [0]
    assert served.notes == []
    served.plant_paused(0, said(0.0), 200.0)
    assert served.paused_pairs(200.0) == []
    served.cost(0, costs_of(start), 205.0)
    assert served.result() is not None


def test_a_paused_plant_that_says_nothing_more_is_silent_in_the_end():
    served = dispatcher()
    ((_, start),) = starts(served.assign(batch(1), 0.0))
    served.plant_paused(0, said(1.0), 1.0)
    served.tick(10.9)
    served.tick(20.0)
    ((_, again),) = starts(served.tick(21.1))
    assert again.episode == start.episode + 1


def test_a_paused_pair_gets_no_new_episode_and_loses_none():
    served = dispatcher(pairs=2)
    (left, right) = starts(served.assign(batch(2), 0.0))
    served.plant_paused(left[0], said(1.0), 1.0)
    assert starts(served.cost(right[0], costs_of(right[1]), 2.0)) == []  # not taken from it
    served.cost(left[0], costs_of(left[1]), 3.0)
    assert served.result() is not None
    ((pair, _), *more) = starts(served.assign(batch(2), 4.0))
    assert pair == right[0]
    assert more == []
    ((pair, _),) = starts(served.plant_paused(left[0], said(0.0), 5.0))
    assert pair == left[0]


def test_a_plant_that_left_in_a_pause_is_not_paused_when_it_is_back():
    served = dispatcher()
    served.plant_paused(0, said(1.0), 1.0)
    served.presence(0, ("plant",), 2.0)
    served.presence(0, (), 3.0)
    assert served.paused_pairs(3.0) == []


def test_the_only_pair_gets_its_next_episode_in_a_pause_too_so_that_it_can_be_stepped_through():
    served = dispatcher()
    served.plant_paused(0, said(1.0), 1.0)
    ((_, first),) = starts(served.assign(batch(1), 1.5))
    served.cost(0, costs_of(first), 2.0)
    served.result()
    assert len(starts(served.assign(batch(1), 2.5))) == 1


@pytest.mark.parametrize("values", [[], [0.5], [1.0, 1.0]])
def test_a_word_about_a_pause_that_is_neither_yes_nor_no_is_refused(values):
    served = dispatcher()
    with pytest.raises(FrameError, match="0 or 1"):
        served.plant_paused(0, Frame(RUN, 1, 0, 0.0, np.array(values)), 0.0)


def test_what_another_plant_says_of_a_pause_does_not_count():
    served = dispatcher()
    ((_, start),) = starts(served.assign(batch(1), 0.0))
    served.cost(0, replace(costs_of(start), plant=5), 0.0)
    served.result()
    served.plant_paused(0, said(1.0, plant=6), 1.0)
    assert served.paused_pairs(1.0) == []


def test_a_held_dispatcher_ends_what_is_under_way_hands_out_nothing_and_keeps_the_plant():
    served = dispatcher(max_batch=1)
    ((_, first),) = starts(served.assign(batch(2), 0.0))
    served.pause()
    assert served.cost(0, costs_of(first), 1.0) == []
    for now in np.arange(2.5, 100.0, 2.5):
        ((_, kept),) = served.tick(now)
        assert kept.frame.episode == first.episode
    assert served.episodes() == []
    assert served.notes == []
    ((_, second),) = starts(served.resume(100.0))
    assert second.episode == first.episode + 1
    served.cost(0, costs_of(second), 101.0)
    assert served.result().costs[:, 0].tolist() == [0.0, 1.0]
