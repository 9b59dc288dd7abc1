# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Trajectories from the topics: complete, attributed, cut where they diverged, or not there at all."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.topics import COMPLETED
from tests.support.dispatching import RUN, batch, costs_of, dispatcher, starts
from tuner_node.batch import Batch, DispatchError
from tuner_node.pair import TrajectoryCollector, cut

STEPS = 30


def samples(start: Frame, plant: int = 0):
    """States and actions of an episode whose values tell (env, step)."""
    count = len(start.values)
    for k in range(STEPS + 1):
        states = np.tile(np.array([k, 0.5]), (count, 1)) + np.arange(count)[:, None] * 100
        yield Frame(RUN, start.episode, k, 0.0, states, plant), -states


def feed(served, pair: int, start: Frame, lose_state: int = -1, lose_action: int = -1) -> None:
    for frame, actions in samples(start):
        if frame.step != lose_state:
            served.state(pair, frame)
        if frame.step != lose_action:
            served.action(pair, replace(frame, values=actions))


def observed(count: int) -> Batch:
    return replace(batch(count), trajectories=True)


def test_trajectories_come_with_the_costs_in_the_batchs_order_over_several_episodes():
    served = dispatcher(pairs=2)
    served.target(0, Frame(0, 0, 0, 0.0, np.ones(2)), 0.0)
    for pair, start in reversed(starts(served.assign(observed(3), 0.0))):
        feed(served, pair, start)
        served.cost(pair, costs_of(start), 0.0)
    result = served.result()
    assert result is not None
    assert result.trajectories is not None
    assert len(result.trajectories) == 3
    assert [t.states.shape for t in result.trajectories] == [(STEPS + 1, 2)] * 3
    assert [t.actions.shape for t in result.trajectories] == [(STEPS, 2)] * 3
    assert result.trajectories[0].states[:, 0].tolist() == list(range(STEPS + 1))
    assert result.target is not None


def test_an_episode_of_one_step_and_one_that_diverged_in_it_are_trajectories():
    states, actions = np.arange(8.0).reshape(2, 2, 2), np.ones((1, 2, 3))
    whole, diverged = cut(states, actions, np.array([COMPLETED, 0.0]))
    assert np.array_equal(whole.states, states[:, 0]) and whole.actions.shape == (1, 3)
    assert np.array_equal(diverged.states, states[:1, 1]) and diverged.actions.shape == (0, 3)


def test_what_comes_after_the_trajectories_were_taken_is_not_kept():
    collector = TrajectoryCollector(RUN, 1)
    for k in range(2):
        collector.take("states", Frame(RUN, 1, k, 0.0, np.ones((1, 2))))
    collector.take("actions", Frame(RUN, 1, 0, 0.0, np.ones((1, 3))))
    assert len(collector.trajectories(0, 1, np.array([COMPLETED]))) == 1
    kept = collector.nbytes
    collector.take("states", Frame(RUN, 1, 2, 0.0, np.ones((1, 2))))
    assert collector.nbytes == kept and not collector.contradiction


def test_a_stranger_with_the_right_ids_fills_no_memory(monkeypatch):
    monkeypatch.setattr("tuner_node.pair.MAX_BYTES", 100_000)
    served = dispatcher()
    served.target(0, Frame(0, 0, 0, 0.0, np.ones(2)), 0.0)
    ((_, start),) = starts(served.assign(observed(1), 0.0))
    feed(served, 0, start)
    forged, refused = Frame(RUN, start.episode, 0, 0.0, np.ones((1, 2)), plant=9), 0
    for step in range(STEPS + 1, 2000):
        try:
            served.action(0, replace(forged, step=step))
        except FrameError as error:
            assert str(error).startswith("expected at most 100000 bytes of samples of one episode")
            refused += 1
    assert refused > 1500
    assert served.pairs[0].samples.nbytes <= 100_000
    served.cost(0, costs_of(start), 0.0)
    assert served.result() is not None  # the plant's came before


def test_a_late_sample_is_waited_for_and_a_lost_one_repeats_the_episode():
    served = dispatcher()
    served.target(0, Frame(0, 0, 0, 0.0, np.ones(2)), 0.0)
    ((_, start),) = starts(served.assign(observed(1), 0.0))
    feed(served, 0, start, lose_action=STEPS - 1)
    assert served.cost(0, costs_of(start), 1.0) == []
    assert served.result() is None
    late = list(samples(start))[STEPS - 1]
    served.action(0, replace(late[0], values=late[1]))
    served.tick(1.2)
    assert served.result() is not None

    ((_, start),) = starts(served.assign(observed(1), 2.0))
    feed(served, 0, start, lose_state=7)
    served.cost(0, costs_of(start), 2.0)
    assert served.tick(2.4) == []
    ((_, again),) = starts(served.tick(2.6))
    assert again.episode == start.episode + 1
    assert "missed 1 samples" in served.notes[-1]
    feed(served, 0, again)
    served.cost(0, costs_of(again), 3.0)
    assert served.result() is not None


def test_samples_of_other_runs_episodes_and_plants_are_not_mixed_in():
    observer = TrajectoryCollector(RUN, 5)
    start = Frame(RUN, 5, 0, 0.0, np.zeros((1, 4)))
    for frame, actions in samples(start, plant=1):
        for stranger in (
            replace(frame, run=RUN + 1),
            replace(frame, episode=4),
            replace(frame, plant=2),
        ):
            observer.take("states", replace(stranger, values=frame.values + 9))
            observer.take("actions", replace(stranger, values=actions + 9))
        observer.take("states", frame)
        observer.take("actions", replace(frame, values=actions))
    assert observer.lost(1, STEPS, 2) == 0
    (trajectory,) = observer.trajectories(1, STEPS, np.array([COMPLETED]))
    assert trajectory.states[:, 0].tolist() == list(range(STEPS + 1))
    (short,) = observer.trajectories(1, STEPS, np.array([12.0]))
    assert short.states.shape == (13, 2)
    assert short.actions.shape == (12, 2)


@pytest.mark.parametrize("shape", [(1, 3), (2, 2), (0, 2), (1, 0), (1, 2, 1)])
def test_samples_of_a_wrong_shape_are_refused_and_change_nothing(shape):
    served = dispatcher()
    served.target(0, Frame(0, 0, 0, 0.0, np.ones(2)), 0.0)
    ((_, start),) = starts(served.assign(observed(1), 0.0))
    forged = Frame(RUN, start.episode, 3, 0.0, np.ones(shape))
    for take in (served.state, served.action):
        with pytest.raises(FrameError, match=r"expected a sample of shape \(1, 2\) for step 3"):
            take(0, forged)
    assert not served.state(0, replace(forged, run=RUN + 1))  # of any shape
    feed(served, 0, start)
    served.cost(0, costs_of(start), 0.0)
    assert served.result() is not None


def test_a_state_of_a_wrong_size_that_came_before_the_target_is_not_taken():
    served = dispatcher()
    ((_, start),) = starts(served.assign(observed(1), 0.0))
    served.state(0, Frame(RUN, start.episode, 3, 0.0, np.ones((1, 5))))
    served.target(0, Frame(0, 0, 0, 0.0, np.ones(2)), 0.0)
    feed(served, 0, start)
    ((_, again),) = starts(served.cost(0, costs_of(start), 0.0))
    assert again.episode == start.episode + 1
    assert "two different states arrived for step 3" in served.notes[-1]


def test_the_cost_of_an_attempt_whose_samples_were_lost_does_not_end_the_next_one():
    served = dispatcher()
    served.target(0, Frame(0, 0, 0, 0.0, np.ones(2)), 0.0)
    ((_, start),) = starts(served.assign(observed(1), 0.0))
    feed(served, 0, start, lose_state=7)
    served.cost(0, costs_of(start), 0.0)
    ((_, again),) = starts(served.tick(1.0))
    assert starts(served.tick(1.9)) == []  # it takes longer than the last samples may
    feed(served, 0, again)
    served.cost(0, costs_of(again), 2.0)
    assert served.result() is not None and len(served.notes) == 1


@pytest.mark.parametrize("kind", ["state", "action"])
@pytest.mark.parametrize("first", [True, False])
def test_two_different_samples_of_one_step_repeat_the_episode(kind, first):
    served = dispatcher()
    served.target(0, Frame(0, 0, 0, 0.0, np.ones(2)), 0.0)
    ((_, start),) = starts(served.assign(observed(1), 0.0))
    forge = partial(getattr(served, kind), 0, Frame(RUN, start.episode, 3, 0.0, np.ones((1, 2))))
    if first:
        forge()
    feed(served, 0, start)
    if not first:
        forge()
    ((_, again),) = starts(served.cost(0, costs_of(start), 0.0))
    assert again.episode == start.episode + 1
    assert f"two different {kind}s arrived for step 3" in served.notes[-1]
    feed(served, 0, again)
    served.cost(0, costs_of(again), 0.0)
    assert served.result() is not None


@pytest.mark.parametrize("kind", ["state", "action"])
@pytest.mark.parametrize("episodes_later", [0, 1])
def test_a_late_sample_that_contradicts_one_that_was_used_ends_the_run(kind, episodes_later):
    served = dispatcher()
    served.target(0, Frame(0, 0, 0, 0.0, np.ones(2)), 0.0)
    ((_, start),) = starts(served.assign(observed(1), 0.0))
    feed(served, 0, start)
    served.cost(0, costs_of(start), 0.0)
    assert served.result() is not None
    if episodes_later:
        served.assign(observed(1), 0.0)
    feed(served, 0, start)  # again the same: no harm
    served.tick(0.0)
    assert not served.state(0, Frame(RUN, start.episode + 9, 0, 0.0, np.ones((1, 2))))
    getattr(served, kind)(0, Frame(RUN, start.episode, 3, 0.0, np.ones((1, 2))))
    # At once: were the tuner killed before its next regular tick, nobody would know any more.
    assert served.state(0, Frame(RUN, start.episode + 9, 0, 0.0, np.ones((1, 2))))
    with pytest.raises(DispatchError, match=f"two different {kind}s .* one of which was used"):
        served.tick(0.0)
