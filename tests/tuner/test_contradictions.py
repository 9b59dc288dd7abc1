# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The dispatcher where results contradict each other, or come from an attempt that failed."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.protocol import ModelFailure
from pdeloop.messages.topics import POLICY, START, episode_name
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
from tests.support.small import same_bits
from tuner_node import dispatch as dispatching
from tuner_node.batch import DispatchError
from tuner_node.dispatch import MAX_TARGET_BYTES, MAX_TARGETS
from tuner_node.pair import FOREIGN_PLANT_GRACE, REMEMBERED


def test_two_different_costs_of_one_episode_end_the_run():
    served = dispatcher()
    ((_, first),) = starts(served.assign(batch(1), 0.0))
    cost = replace(costs_of(first), plant=5)
    served.cost(0, cost, 0.0)
    assert served.cost(0, cost, 0.0) == []
    assert served.cost(0, void_of(first), 0.0) == []  # gave up what another one has done
    assert served.cost(0, replace(cost, plant=6, values=2 * cost.values), 0.0) == []
    with pytest.raises(DispatchError, match=r"two different messages on episode/cost answer"):
        served.cost(0, replace(cost, values=np.nextafter(cost.values, 9.0)), 0.0)


def test_answers_of_the_last_16_episodes_can_be_contradicted_and_of_none_before():
    assert REMEMBERED == 16
    served, costs = dispatcher(), []
    for now in range(20):
        ((_, start),) = starts(served.assign(batch(1), float(now)))
        costs.append(costs_of(start))
        served.cost(0, costs[-1], float(now))
        assert served.result() is not None
    others = [replace(cost, values=cost.values + 1.0) for cost in costs]
    for forgotten in others[:4]:
        assert served.cost(0, forgotten, 20.0) == []
    for known in others[4:]:
        with pytest.raises(DispatchError, match=r"two different messages on episode/cost answer"):
            served.cost(0, known, 20.0)


def test_two_different_targets_of_the_run_s_plant_end_the_run():
    served = dispatcher(plant=5)
    target = Frame(0, 0, 0, 0.0, np.arange(3.0), 5)
    other = replace(target, values=target.values + 1e-9)
    assert served.target(0, target, 0.0) == served.target(0, target, 1.0) == []
    assert served.target(0, replace(other, plant=6), 0.0) == []
    assert served.target(0, replace(target, plant=6), 0.0) == []  # not this run's plant
    with pytest.raises(DispatchError, match="two different targets arrived for the plant 5"):
        served.target(0, other, 2.0)


def test_targets_of_ever_new_plants_fill_no_memory():
    served, values = dispatcher(), np.zeros(2**22)
    refused = 0
    tracemalloc.start()
    for plant in range(30):
        try:
            served.target(0, Frame(0, 0, 0, 0.0, values, plant), 0.0)
        except FrameError as error:
            assert "expected the targets of at most" in str(error)
            refused += 1
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert refused and peak < 1.1 * MAX_TARGET_BYTES
    ((_, start),) = starts(served.assign(batch(1), 0.0))
    served.cost(0, replace(costs_of(start), plant=3), 1.0)  # the run's plant is known from now on
    for plant in range(30):
        assert served.target(0, Frame(0, 0, 0, 0.0, values, plant), 2.0) == []


def test_targets_of_just_the_bytes_that_are_allowed_are_remembered(monkeypatch):
    monkeypatch.setattr(dispatching, "MAX_TARGET_BYTES", 32)
    served = dispatcher()
    for plant in (1, 2):
        served.target(0, Frame(0, 0, 0, 0.0, np.zeros(2), plant), 0.0)
    with pytest.raises(FrameError, match="expected the targets of at most"):
        served.target(0, Frame(0, 0, 0, 0.0, np.zeros(2), 3), 0.0)


def test_a_start_is_signed_and_a_policy_is_of_the_plant_that_it_does_not_know():
    served = dispatcher()
    sends = {send.topic: send.frame for _, send in served.assign(batch(1), 0.0)}
    assert sends[POLICY].plant == 0 != sends[START].plant


def test_the_target_of_the_run_s_plant_has_room_as_soon_as_that_is_known():
    served = dispatcher()
    for plant in range(MAX_TARGETS):
        served.target(0, Frame(0, 0, 0, 0.0, np.zeros(2), plant), 0.0)
    own = Frame(0, 0, 0, 0.0, np.ones(2), 99)
    with pytest.raises(FrameError, match="expected the targets of at most 64 plants"):
        served.target(0, own, 0.0)
    ((_, start),) = starts(served.assign(batch(1), 0.0))
    served.cost(0, replace(costs_of(start), plant=99), 1.0)
    assert served.target(0, own, 2.0) == []
    result = served.result()
    assert result is not None and result.target is not None
    assert result.target.tolist() == [1.0, 1.0]


def test_another_plant_ends_the_run_only_where_that_of_the_run_never_was():
    for there in (True, False):
        served = dispatcher(plant=5)
        ((_, start),) = starts(served.assign(batch(1), 0.0))
        if there:
            served.target(0, Frame(0, 0, 0, 0.0, np.arange(3.0), 5), 0.0)
        foreign = replace(costs_of(start), plant=6)
        for now in np.arange(1.0, 40.0, 0.5):
            late = now > 1.0 + FOREIGN_PLANT_GRACE and not there
            with pytest.raises(DispatchError if late else FrameError, match="other parameters"):
                served.cost(0, foreign, now)
        served.cost(0, replace(foreign, plant=5), 40.0)
        assert served.result() is not None


def test_a_cost_that_is_taken_back_after_it_was_used_ends_the_run():
    served = dispatcher()
    ((_, first),) = starts(served.assign(batch(2), 0.0))
    served.cost(0, costs_of(first), 0.0)
    assert served.result() is not None
    ((_, second),) = starts(served.assign(batch(2), 1.0))
    with pytest.raises(
        DispatchError, match=f"withdrew the cost of episode {episode_name(first.episode)}"
    ):
        served.cost(0, replace(void_of(first), step=costs_of(first).step), 1.0)
    served.cost(0, costs_of(second), 1.0)
    with pytest.raises(DispatchError, match=r"two different messages on episode/cost"):
        served.cost(0, replace(costs_of(first), values=costs_of(first).values + 1.0), 2.0)


@pytest.mark.parametrize("paused", [False, True])
def test_an_episode_that_fails_when_it_is_run_again_is_told_from_a_cost_that_is_taken_back(paused):
    served = dispatcher()
    ((_, start),) = starts(served.assign(batch(1), 0.0))
    if paused:
        served.pause()
    cost = costs_of(start)
    served.cost(0, cost, 1.0)
    assert served.cost(0, void_of(start), 2.0) == []
    with pytest.raises(DispatchError, match="withdrew the cost of episode"):
        served.cost(0, replace(void_of(start), step=cost.step), 3.0)


def test_two_different_models_of_one_episode_end_the_run():
    served = dispatcher()
    ((_, first),) = starts(served.assign(EXPLORATION, 0.0))
    model = Frame(RUN, first.episode, 0, 1.0, np.ones((1, 7)))
    served.model(0, model, 0.0)
    served.model(0, model, 0.0)
    served.cost(0, costs_of(first), 0.0)
    assert served.result() is not None
    assert served.model(0, model, 0.0) == []
    with pytest.raises(DispatchError, match=r"two different messages on model/identified answer"):
        served.model(0, replace(model, values=2 * model.values), 0.0)


def test_a_model_of_another_plant_is_refused_and_that_of_the_run_s_is_taken():
    served = dispatcher(plant=5)
    ((_, start),) = starts(served.assign(EXPLORATION, 0.0))
    with pytest.raises(FrameError, match="expected a model of plant 5, got one of 6"):
        served.model(0, model_of(start, plant=6), 0.0)
    served.cost(0, replace(costs_of(start), plant=5), 0.0)
    assert served.result() is None
    served.model(0, model_of(start, plant=5), 0.0)
    assert served.result() is not None


@pytest.mark.parametrize("first", ["cost", "model"])
def test_no_result_of_an_attempt_that_failed_is_used(first):
    served = dispatcher()
    ((_, start),) = starts(served.assign(EXPLORATION, 0.0))
    if first == "cost":
        served.cost(0, costs_of(start), 0.0)
        failure = ModelFailure(RUN, start.episode, True, "a state was lost")
        ((_, again),) = starts(served.failure(0, failure, 0.0))
        served.model(0, model_of(again, 2.0), 0.0)
    else:
        served.model(0, model_of(start), 0.0)
        ((_, again),) = starts(served.cost(0, void_of(start), 0.0))
        served.cost(0, costs_of(again), 0.0)
    assert served.result() is None
    served.cost(0, costs_of(again), 0.0)
    served.model(0, model_of(again, 2.0), 0.0)
    result = served.result()
    assert result is not None and same_bits(result.models, model_of(again, 2.0).values)
