# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The dispatcher: whatever pairs do, every row of a batch gets its own result, once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.protocol import ModelFailure
from pdeloop.messages.topics import COMPLETED, MODEL, POLICY, START, episode_name
from tests.support.dispatching import (
    EXPLORATION,
    RUN,
    batch,
    costs_of,
    dispatcher,
    model_of,
    starts,
    void_of,
)
from tests.support.small import dispatcher_of, same_bits
from tuner_node.batch import Batch, DispatchError


@pytest.mark.parametrize("pairs", [1, 2, 3, 5])
@pytest.mark.parametrize("count", [1, 3, 4, 11])
def test_any_number_of_pairs_and_any_order_of_arrival_gives_the_batch_in_order(pairs, count):
    rng = np.random.default_rng(pairs * 100 + count)
    served = dispatcher(pairs)
    open_episodes = starts(served.assign(batch(count), 0.0))
    while open_episodes:
        pair, frame = open_episodes.pop(int(rng.integers(len(open_episodes))))
        assert len(frame.values) <= 4
        answer = void_of(frame) if rng.random() < 0.2 else costs_of(frame)
        try:
            open_episodes += starts(served.cost(pair, answer, 0.0))
        except DispatchError:
            pytest.fail("three voids in a row are not in this seed")
    result = served.result()
    assert result is not None
    assert result.costs[:, 0].tolist() == [i**2 for i in range(count)]
    assert served.result() is None


@pytest.mark.parametrize(("most", "sizes"), [(1, [1, 1]), (2, [2]), (4, [2])])
def test_no_episode_has_more_rows_than_a_plant_has_environments(most, sizes):
    rows = np.array([[3.0, 4.0, 0.1, 0.0], [5.0, 6.0, 0.1, 0.0]])
    served = dispatcher(max_batch=most)
    [(_, frame)] = starts(served.assign(Batch(rows, None, together=2), 0.0))
    seen = [len(frame.values)]
    while len(seen) < len(sizes):
        served.cost(0, costs_of(frame), 0.0)
        [(_, frame)] = starts(served.model(0, model_of(frame), 0.0))
        seen.append(len(frame.values))
    assert seen == sizes


def test_the_policy_goes_out_before_the_start_and_with_its_rows():
    served = dispatcher()
    publications = served.assign(batch(2), 0.0)
    assert [send.topic for _, send in publications] == [POLICY, START]
    policy, start = (send.frame for _, send in publications)
    assert policy.episode == start.episode == 2**32 + 1
    assert policy.values[:, 0, 0].tolist() == start.values[:, 0].tolist()


def test_answers_of_other_runs_episodes_and_shapes_change_nothing():
    served = dispatcher()
    ((_, start),) = starts(served.assign(batch(2), 0.0))
    good = costs_of(start)
    assert served.cost(0, Frame(RUN + 1, good.episode, 30, 0.0, good.values), 0.0) == []
    assert served.cost(0, Frame(RUN, good.episode - 1, 30, 0.0, good.values), 0.0) == []
    with pytest.raises(FrameError, match="costs of shape"):
        served.cost(0, Frame(RUN, good.episode, 30, 0.0, good.values[:1]), 0.0)
    assert served.result() is None
    served.cost(0, good, 0.0)
    assert served.result() is not None
    assert sum(served.counters.values()) == 2


@pytest.mark.parametrize("cost_first", [True, False])
def test_trajectories_are_complete_with_the_last_sample_or_the_cost(cost_first):
    served = dispatcher()
    ((_, start),) = starts(served.assign(replace(batch(2), trajectories=True), 0.0))
    cost = costs_of(start)
    served.target(0, Frame(0, 0, 0, 0.0, np.zeros(3)), 0.0)

    def samples() -> list[bool]:
        told = []
        for k in range(cost.step + 1):
            told.append(served.state(0, replace(start, plant=0, step=k, values=np.full((2, 3), k))))
            if k < cost.step:
                served.action(0, replace(start, plant=0, step=k, values=np.zeros((2, 2))))
        return told

    if cost_first:
        served.cost(0, cost, 0.0)
        assert served.result() is None
        assert samples() == [False] * cost.step + [True]
        served.tick(0.0)
    else:
        assert not any(samples())
        served.cost(0, cost, 0.0)
    result = served.result()
    assert result is not None and result.trajectories is not None
    assert [t.states[:, 0].tolist() for t in result.trajectories] == [list(range(31))] * 2


def diverged(frame: Frame) -> Frame:
    """The cost of an episode whose first row diverged at step 7."""
    cost = costs_of(frame)
    cost.values[0, -1] = 7.0
    return cost


@pytest.mark.parametrize("first", ["cost", "failure"])
def test_an_exploration_that_diverged_is_a_result_without_a_model(first):
    served = dispatcher()
    ((_, start),) = starts(served.assign(EXPLORATION, 0.0))
    failure = ModelFailure(RUN, start.episode, False, "the plant diverged")
    if first == "cost":
        served.cost(0, diverged(start), 0.0)
        assert served.result() is None  # the reason is on its way
        served.failure(0, failure, 0.0)
    else:
        served.failure(0, failure, 0.0)
        assert served.result() is None
        served.cost(0, diverged(start), 0.0)
    result = served.result()
    assert result.models is None and same_bits(result.costs, diverged(start).values)
    ((_, again),) = starts(served.assign(EXPLORATION, 0.0))
    assert served.failure(0, failure, 0.0) == []  # said once more, as its start was repeated
    served.cost(0, costs_of(again), 0.0)
    served.model(0, model_of(again), 0.0)
    assert same_bits(served.result().models, model_of(again).values)


def test_where_one_episode_diverged_no_model_of_the_others_is_given():
    """Otherwise it would depend on the number of pairs which models there are."""
    served = dispatcher(2)
    rows = np.array([[3.0, 4.0, 0.1, 0.0], [5.0, 6.0, 0.1, 1.0]])
    sent = starts(served.assign(Batch(rows, None), 0.0))
    (bad, first), (good, second) = sent
    served.cost(bad, diverged(first), 0.0)
    served.failure(bad, ModelFailure(RUN, first.episode, False, "the plant diverged"), 0.0)
    served.cost(good, costs_of(second), 0.0)
    served.model(good, model_of(second), 0.0)
    result = served.result()
    assert result.models is None and result.costs[:, -1].tolist() == [7.0, COMPLETED]


@pytest.mark.parametrize("retry", [True, False])
def test_a_failed_model_of_another_run_neither_ends_nor_repeats_an_episode(retry):
    served = dispatcher()
    ((_, start),) = starts(served.assign(EXPLORATION, 0.0))
    assert served.failure(0, ModelFailure(RUN + 1, start.episode, retry, "no"), 0.0) == []
    assert served.notes == [] and served.episodes() == [start.episode]


def test_whoever_does_not_answer_is_sent_the_models_too_as_they_were_published():
    served, models = dispatcher(), np.ones((1, 9, 2))
    served.models(models, 1)
    models += 1.0  # the training works on
    served.assign(batch(1), 0.0)
    again = [send for _, send in served.tick(3.0)]
    assert [send.topic for send in again] == [MODEL, POLICY, START]
    assert again[0].frame.step == 1 and same_bits(again[0].frame.values, np.ones((1, 9, 2)))


def test_a_model_that_comes_again_and_again_is_no_answer_of_a_silent_plant():
    served = dispatcher(episode_timeout=10.0)
    ((_, first),) = starts(served.assign(EXPLORATION, 0.0))
    for now in range(1, 10):
        served.model(0, Frame(RUN, first.episode, 0, 1.0, np.ones((1, 7))), float(now))
        assert served.notes == []
        served.tick(float(now))
    ((_, second),) = starts(served.tick(11.5))
    assert second.episode == first.episode + 1
    assert "silent" in served.notes[-1]


def test_a_void_episode_is_repeated_under_a_new_number_and_given_up_at_last():
    served = dispatcher()
    ((_, first),) = starts(served.assign(batch(1), 0.0))
    ((_, second),) = starts(served.cost(0, void_of(first), 0.0))
    assert second.episode == first.episode + 1
    assert np.array_equal(second.values, first.values)
    assert served.cost(0, costs_of(first), 0.0) == []  # the void one is over
    ((_, third),) = starts(served.cost(0, void_of(second), 0.0))
    with pytest.raises(DispatchError, match="gave up after 3 attempts"):
        served.cost(0, void_of(third), 0.0)


def test_nothing_is_handed_to_an_absent_pair_and_a_silent_one_is_repeated():
    served = dispatcher_of(run=RUN)
    assert served.assign(batch(1), 0.0) == []
    assert served.missing() == ["plant", "controller"]
    assert served.presence(0, ("controller",), 1.0) == []
    ((_, first),) = starts(served.presence(0, (), 2.0))
    assert served.tick(3.9) == []
    ((_, asked_again),) = starts(served.tick(4.1))  # a lost message costs two seconds
    assert asked_again.episode == first.episode
    assert served.tick(4.2) == []
    ((_, second),) = starts(served.tick(12.1))
    assert second.episode == first.episode + 1


def test_large_states_and_models_are_asked_for_less_often():
    """A start that is repeated is answered with a state, and a repeated model is as large as states."""
    served = dispatcher(state_size=2**17, horizon=10, episode_timeout=1e3)
    served.assign(batch(2), 0.0)
    assert served.tick(7.9) == []
    assert [send.topic for _, send in served.tick(8.1)] == [POLICY, START]
    served.models(np.zeros((1, 2**12, 32)), 1)
    sent = [[send.topic for _, send in served.tick(8.1 * n)] for n in range(2, 10)]
    assert [MODEL in topics for topics in sent].count(True) == 4  # of eight, every second one
    assert all(START in topics for topics in sent)
    served.pairs[0].paused_until = 90.0  # a paused plant is kept for this run by starts as ever
    assert [send.topic for _, send in served.tick(75.0)][-1:] == [START]


def test_an_absent_pair_is_waited_for_when_it_is_the_only_one():
    served = dispatcher()
    ((_, start),) = starts(served.assign(batch(1), 0.0))
    served.presence(0, ("plant",), 1.0)
    assert served.tick(1000.0) == []
    served.presence(0, (), 1001.0)
    served.cost(0, costs_of(start), 1002.0)
    assert served.result() is not None


def test_the_work_of_a_pair_that_died_goes_to_a_free_one():
    served = dispatcher(pairs=2)
    ((pair, start),) = starts(served.assign(batch(1), 0.0))
    ((other, again),) = starts(served.presence(pair, ("plant",), 1.0))
    assert other != pair
    assert np.array_equal(again.values, start.values)
    assert served.cost(pair, costs_of(start), 2.0) == []  # the dead one's late answer
    served.cost(other, costs_of(again), 3.0)
    assert served.result() is not None


def test_the_work_of_a_pair_that_died_while_all_were_busy_goes_to_the_first_free_one():
    served = dispatcher(pairs=2)
    (left, right) = starts(served.assign(batch(2), 0.0))
    assert served.presence(left[0], ("plant", "controller"), 1.0) == []
    ((pair, again),) = starts(served.cost(right[0], costs_of(right[1]), 2.0))
    assert pair == right[0]
    assert np.array_equal(again.values, left[1].values)
    served.cost(pair, costs_of(again), 3.0)
    result = served.result()
    assert result is not None
    assert result.costs[:, 0].tolist() == [0.0, 1.0]


@pytest.mark.parametrize(("wanted", "count"), [(EXPLORATION, 2), (batch(1), 1)])
def test_models_that_were_not_asked_for_are_refused(wanted, count):
    served = dispatcher()
    ((_, start),) = starts(served.assign(wanted, 0.0))
    with pytest.raises(FrameError, match=f"expected 1 models, got {count}"):
        served.model(0, Frame(RUN, start.episode, 0, 0.0, np.ones((count, 9, 2))), 0.0)
    assert served.pairs[0].chunk.models is None


@pytest.mark.parametrize("design", [0, 5])
def test_a_tuner_looks_at_a_models_signature_if_it_knows_how_models_are_identified(design):
    served = dispatcher(design=design)
    ((_, start),) = starts(served.assign(EXPLORATION, 0.0))
    model = Frame(RUN, start.episode, 0, -12345.0, np.ones((1, 9, 2)))  # signed by somebody
    if design:
        with pytest.raises(FrameError, match="identified with the parameters of this run"):
            served.model(0, model, 0.0)
    else:
        served.model(0, model, 0.0)
    assert (served.pairs[0].chunk.models is None) == bool(design)


def test_an_exploratory_episode_is_done_with_its_model_and_fails_with_its_reason():
    served = dispatcher()
    ((_, start),) = starts(served.assign(EXPLORATION, 0.0))
    served.cost(0, costs_of(start), 0.0)
    assert served.result() is None
    ((_, again),) = starts(
        served.failure(0, ModelFailure(RUN, start.episode, True, "a state was lost"), 0.0)
    )
    served.cost(0, costs_of(again), 0.0)
    served.model(0, Frame(RUN, again.episode, 0, 0.0, np.ones((1, 9, 2))), 0.0)
    result = served.result()
    assert result is not None
    assert result.models is not None
    ((_, last),) = starts(served.assign(EXPLORATION, 0.0))
    assert served.failure(0, ModelFailure(RUN, last.episode, False, "p is too large"), 0.0) == []
    with pytest.raises(DispatchError, match="no reduced model: p is too large"):
        served.cost(0, costs_of(last), 0.0)
    with pytest.raises(
        DispatchError, match=f"withdrew episode {episode_name(again.episode)}.*two st"
    ):
        served.failure(0, ModelFailure(RUN, again.episode, False, "two states came"), 0.0)
    for known in (start, again):  # a controller that was started anew has lost the states
        assert served.failure(0, ModelFailure(RUN, known.episode, True, "0 states"), 0.0) == []


def test_costs_of_a_plant_with_other_parameters_are_refused():
    served = dispatcher()
    ((_, first),) = starts(served.assign(batch(1), 0.0))
    served.cost(0, replace(costs_of(first), plant=5), 0.0)
    assert served.result().plant == 5
    ((_, second),) = starts(served.assign(batch(1), 0.0))
    with pytest.raises(FrameError, match="other parameters"):
        served.cost(0, replace(costs_of(second), plant=6), 0.0)
    assert served.result() is None
    served.cost(0, replace(costs_of(second), plant=5), 0.0)
    assert served.result() is not None
