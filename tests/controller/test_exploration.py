# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a controller makes of an exploration: its model, or the reason why there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller_node.identification import DesignSettings
from controller_node.responder import Responder
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.frames import Frame
from pdeloop.messages.protocol import ModelFailure
from pdeloop.messages.topics import ACTION, COMPLETED, MODEL_IDENTIFIED, VOID, CostColumn
from tests.support.responding import COSTS, RUN, SETTINGS, explore, models, plant, start, target
from tests.support.small import same_bits


def test_exploration_gives_the_model_of_the_same_trajectory_in_process(responder):
    (send,) = explore(responder, 1)
    assert send.topic is MODEL_IDENTIFIED
    assert not responder.under_way
    assert same_bits(send.frame.values, models())
    assert (send.frame.run, send.frame.episode, send.frame.step) == (RUN, 1, 0)
    (again,) = responder.cost(Frame(RUN, 1, 30, 1.0, COSTS))
    assert same_bits(again.frame.values, send.frame.values)


@pytest.mark.parametrize("environment", [0, 1])
def test_an_exploration_of_which_one_environment_is_void_gives_no_model(responder, environment):
    responder.start(start(1, (1, 2, 0.1, 0), (3, 4, 0.1, 0)))
    states = plant().reset(np.array([1, 3]))
    for k in range(31):
        (send,) = responder.state(Frame(RUN, 1, k, 0.0, states))
        states = plant().step(send.frame.values) if k < 30 else states
    costs = np.repeat(COSTS, 2, axis=0)
    costs[environment, CostColumn.ENDED] = VOID
    (failure,) = responder.cost(Frame(RUN, 1, 30, 1.0, costs))
    assert isinstance(failure, ModelFailure) and failure.retry
    assert failure.reason == "the exploratory episode is void"


def test_a_state_beyond_the_last_one_does_not_count_for_one_that_was_lost(responder):
    responder.start(start(1, (1, 2, 0.1, 0)))
    responder.state(Frame(RUN, 1, 31, 0.0, plant().reset(np.array([1]))))
    (failure,) = explore(responder, 1, lose=7)
    assert isinstance(failure, ModelFailure) and failure.retry


def test_the_actions_of_an_exploration_are_limited_as_those_of_the_law():
    free, limited = (
        Responder(replace(SETTINGS, action_set=ActionSet(limit=limit))) for limit in (0.0, 0.05)
    )
    for made in (free, limited):
        made.target(target())
        made.start(start(1, (1, 2, 0.1, 0)))
    state = Frame(RUN, 1, 0, 0.0, plant().reset(np.array([1])).copy())
    a, b = (made.state(state)[0].frame.values for made in (free, limited))
    assert np.abs(a).max() > 0.05
    assert same_bits(b, np.clip(a, -0.05, 0.05))


def test_a_lost_sample_asks_for_the_episode_again_and_the_repeat_gives_the_model(responder):
    (failure,) = explore(responder, 1, lose=7)
    assert isinstance(failure, ModelFailure)
    assert failure.retry
    assert "30 of the 31 states" in failure.reason
    assert ModelFailure.from_json(failure.to_json()) == failure
    (send,) = explore(responder, 2)
    assert same_bits(send.frame.values, models())


@pytest.mark.parametrize("ended", [VOID, COMPLETED])
def test_an_exploration_that_ends_before_its_first_step_is_asked_for_again(responder, ended):
    """Void before its first action; a forged cost may say that it was completed."""
    responder.start(start(1, (1, 2, 0.1, 0)))
    responder.state(Frame(RUN, 1, 0, 0.0, plant().reset(np.array([1]))))
    (failure,) = responder.cost(Frame(RUN, 1, 0, 0.0, np.array([[0.0, 0.0, ended]])))
    assert isinstance(failure, ModelFailure) and failure.retry
    assert failure.reason == "the exploratory episode is void"
    (send,) = explore(responder, 2)
    assert same_bits(send.frame.values, models())


def test_a_void_exploration_forged_into_a_completed_one_names_who_else_may_have_said_so(responder):
    responder.start(start(1, (1, 2, 0.1, 0)))
    states = plant().reset(np.array([1]))
    for k in range(2):
        responder.state(Frame(RUN, 1, k, 0.0, states))
    (failure,) = responder.cost(Frame(RUN, 1, 1, 0.0, np.array([[0.5, 0.5, COMPLETED]])))
    assert isinstance(failure, ModelFailure) and not failure.retry
    assert failure.reason == (
        "a model of n_s = 4 modes and n_a = 4 inputs needs at least 8 steps, but there are 1; take "
        "more steps (a longer horizon), or a lower n_s where that is enough. (The exploratory "
        "episode ended at step 1: if the horizon is longer, stop the other node that publishes "
        "episode/cost.)"
    )


@pytest.mark.parametrize("forged", [False, True])
def test_a_divergence_that_the_states_do_not_show_names_who_else_may_have_said_so(
    responder, forged
):
    made = plant()
    states = made.reset(np.array([1]))
    responder.start(start(1, (1, 2, 0.1 if forged else 1e9, 0)))
    for k in range(31):
        (send,) = responder.state(Frame(RUN, 1, k, 0.0, states))
        states = made.step(send.frame.values) if k < 30 else states
    cost = made.episode_costs().rows()
    assert (cost[0, CostColumn.ENDED] == COMPLETED) == forged
    cost[0, CostColumn.ENDED] = 0.0
    (failure,) = responder.cost(Frame(RUN, 1, 30, 0.0, cost))
    assert isinstance(failure, ModelFailure) and not failure.retry
    told = "the plant diverged under exploration at step 0; lower exploration_variance"
    if forged:
        told += (
            ", or measurement_noise, which raises it; without such noise, stop the other node that "
            "publishes episode/cost, as the states still changed after that step"
        )
    assert failure.reason == told


def test_a_divergence_of_which_states_are_missing_is_asked_for_again(responder):
    responder.start(start(1, (1, 2, 0.1, 0)))
    responder.state(Frame(RUN, 1, 0, 0.0, plant().reset(np.array([1]))))
    (failure,) = responder.cost(Frame(RUN, 1, 30, 0.0, np.array([[1e9, 3e10, 0.0]])))
    assert isinstance(failure, ModelFailure) and failure.retry
    assert "holds 1 of the 31 states" in failure.reason


def test_data_that_allow_no_model_are_a_failure_with_the_reason():
    responder = Responder(DesignSettings(4, 400, 1.0, 1.0))
    responder.target(target())
    (failure,) = explore(responder, 1)
    assert not failure.retry
    assert "needs at least" in failure.reason


def test_states_of_two_plants_are_not_mixed_into_one_model(responder):
    responder.target(Frame(0, 0, 0, 0.0, plant().target, plant=9))
    responder.start(start(1, (1, 2, 0.1, 0)))
    stranger = np.random.default_rng(0).standard_normal((1, 32))
    for k in range(31):
        (send,) = responder.state(Frame(RUN, 1, k, 0.0, stranger, plant=9))
        assert send.frame.plant == 9
    (send,) = explore(responder, 1)
    assert same_bits(send.frame.values, models())


def test_two_different_states_of_one_step_give_no_model_and_ask_for_the_episode_again(responder):
    responder.start(start(1, (1, 2, 0.1, 0)))
    states = plant().reset(np.array([1]))
    responder.state(Frame(RUN, 1, 0, 0.0, states))
    responder.state(Frame(RUN, 1, 3, 0.0, states + 1.0))  # before the plant's
    (failure,) = explore(responder, 1)
    assert isinstance(failure, ModelFailure) and failure.retry
    assert "two different states arrived for step 3" in failure.reason
    (model,) = explore(responder, 2)
    assert model.topic is MODEL_IDENTIFIED


def test_an_exploration_waits_for_its_start_and_the_target_alone():
    made = Responder(SETTINGS)
    state = Frame(RUN, 1, 0, 0.0, plant().reset(np.array([1])).copy())
    assert made.waits_for() == [] and made.state(state) == []
    assert made.waits_for() == ["episode/start", "target"]
    made.start(start(1, (1, 2, 0.1, 0)))
    assert made.waits_for() == ["target"]
    assert len(made.target(target())) == 1 and made.waits_for() == []


def test_a_state_that_contradicts_an_exploration_takes_back_its_model_once(responder):
    (model,) = explore(responder, 1)
    assert model.topic is MODEL_IDENTIFIED
    last = Frame(RUN, 1, 3, 0.0, plant().reset(np.array([1])) + 1.0, model.frame.plant)
    action, failure = responder.state(last)
    assert action.topic is ACTION
    assert isinstance(failure, ModelFailure) and "two different states arrived" in failure.reason
    assert len(responder.state(last)) == 1
    assert responder.start(start(1, (1, 2, 0.1, 0))) == [failure]
    assert responder.cost(replace(model.frame, step=30, values=COSTS)) == [failure]
