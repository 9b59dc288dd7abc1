# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Who else is on the network: what a tuner waits for, and what ends it."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import POLICY, START
from tests.support.small import dispatcher_of
from tuner_node.batch import Batch, DispatchError
from tuner_node.dispatch import PAUSE_LEASE
from tuner_node.session import SECOND_TUNER_GRACE, Participants, Publishers


def participants(recorder: str = "none", *, pairs: int = 1, established: bool = False) -> Any:
    """Participants of a session that has begun nothing yet, and its dispatcher."""
    dispatcher = dispatcher_of(n_a=1, pairs=pairs)
    session = SimpleNamespace(dispatcher=dispatcher, established=established)
    return Participants(session, recorder), dispatcher  # type: ignore[arg-type]


def there(
    plants: int = 1, controllers: int = 1, tuners: int = 1, recorders: int = 0, unmatched: int = 0
) -> Publishers:
    return Publishers([plants], [controllers], {"/episode/start": tuners}, recorders, unmatched)


def test_the_dispatcher_learns_which_nodes_of_each_pair_are_missing():
    company, dispatcher = participants(pairs=2)
    company.update(Publishers([1, 0], [0, 1], {}, 0), 0.0)
    assert [sorted(pair.missing) for pair in dispatcher.pairs] == [["controller"], ["plant"]]
    company.update(Publishers([1, 1], [1, 1], {}, 0), 1.0)
    assert dispatcher.missing() == []


def test_what_the_time_asks_for_is_sent_with_what_the_presence_does():
    company, dispatcher = participants()
    company.update(there(), 0.0)
    batch = Batch(np.array([[1.0, -1.0, 0.0, 0.0]]), np.zeros((1, 1, 2)))
    dispatcher.assign(batch, 0.0)
    assert {send.topic for _, send in company.update(there(), 9.0)} == {POLICY, START}


@pytest.mark.parametrize("recorder", ["start", "required"])
def test_the_first_episode_waits_for_a_recorder(recorder: str):
    company, dispatcher = participants(recorder)
    company.update(there(), 0.0)
    assert dispatcher.missing() == ["recorder"]
    company.update(there(recorders=1, unmatched=1), 0.5)  # an episode's start could be lost
    assert dispatcher.missing() == ["recorder"]
    company.update(there(recorders=1), 1.0)
    assert dispatcher.missing() == []
    company.update(there(recorders=1, unmatched=1), 2.0)  # it began with one
    assert dispatcher.missing() == []


def test_a_recorder_that_goes_ends_the_training_only_where_it_is_required():
    company, dispatcher = participants("start")
    company.update(there(recorders=1), 0.0)
    company.update(there(recorders=0), 1.0)
    assert dispatcher.missing() == []
    company, dispatcher = participants("required")
    company.update(there(recorders=0), 0.0)
    company.update(there(recorders=1), 1.0)
    with pytest.raises(DispatchError, match=r"the recorder has gone.*resume:=true"):
        company.update(there(recorders=0), 2.0)


def test_another_tuner_ends_this_one_unless_it_came_first_or_is_only_seen_for_a_while():
    company, _ = participants()
    company.update(there(tuners=2), 0.0)
    company.update(there(tuners=2), SECOND_TUNER_GRACE)
    company.update(there(tuners=1), SECOND_TUNER_GRACE + 1)  # it was one that had been killed
    company.update(there(tuners=2), 20.0)
    with pytest.raises(DispatchError, match="another tuner publishes /episode/start; stop it"):
        company.update(there(tuners=2), 20.1 + SECOND_TUNER_GRACE)
    company, _ = participants(established=True)
    for now in (0.0, 2 * SECOND_TUNER_GRACE):
        company.update(there(tuners=2), now)


@pytest.mark.parametrize(("pairs", "which"), [(1, ""), (2, " of pair 1")])
def test_a_pause_is_told_once(pairs: int, which: str):
    company, dispatcher = participants(pairs=pairs)
    assert company.newly_paused(0.0) == ""
    dispatcher.plant_paused(pairs - 1, Frame(7, 0, 0, 0.0, np.ones(1)), 1.0)
    assert re.fullmatch(f"the plant{which} is paused", company.newly_paused(1.5))
    assert company.newly_paused(2.0) == ""
    assert company.newly_paused(1.1 + PAUSE_LEASE) == "no plant is paused"
