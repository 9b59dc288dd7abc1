# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant under messages that contradict each other: the episode is void, and its cost no cost."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pde_sim_node.taken_actions import REMEMBERED
from pdeloop.messages.topics import COST, VOID, CostColumn
from tests.support.lockstep import (
    RUN,
    answer,
    is_void,
    kept,
    outcome,
    plant_protocol,
    run_episode,
    start,
)


def test_two_different_actions_for_one_state_void_the_episode():
    quiet = run_episode(plant_protocol(), 1)
    protocol = plant_protocol()
    (send,) = protocol.start(start(1), 0.0)
    for step in range(20):
        assert send.frame.step == step
        (send,) = protocol.action(answer(send.frame, scale=7.0 if step == 3 else 0.1), 0.0)
    assert protocol.action(answer(quiet[3 - 1]), 0.0) == []
    other = answer(quiet[3])
    assert protocol.action(replace(other, values=other.values[:1]), 0.0) == []
    (void,) = protocol.action(answer(quiet[3]), 0.0)
    assert void.topic is COST
    assert (void.frame.values[:, CostColumn.ENDED] == VOID).all()
    assert protocol.contradiction.startswith(
        "two different actions arrived for step 3 of episode 1;"
    )
    again = run_episode(protocol, 2)
    assert again[-1].values.tobytes() == quiet[-1].values.tobytes()
    assert protocol.contradiction == ""


@pytest.mark.parametrize("environment", [0, 1])
def test_an_action_that_differs_in_one_environment_voids_the_episode(environment):
    protocol = plant_protocol()
    (send,) = protocol.start(start(1), 0.0)
    first = answer(kept(send.frame))
    protocol.action(first, 0.0)
    other = first.values.copy()
    other[environment, -1] += 1e-12
    assert is_void(*protocol.action(replace(first, values=other), 0.0))


def test_a_void_episode_is_not_declared_void_again_by_what_comes_later():
    protocol = plant_protocol()
    (send,) = protocol.start(start(1), 0.0)
    first = kept(send.frame)
    protocol.action(answer(first), 0.0)
    assert is_void(*protocol.action(answer(first, scale=0.2), 0.0))
    assert protocol.action(answer(first, scale=0.3), 0.0) == []


@pytest.mark.parametrize("later", [0, 3])
def test_an_action_that_contradicts_one_of_an_episode_that_ended_takes_its_cost_back(later):
    protocol = plant_protocol()
    *states, cost = run_episode(protocol, 1)
    for episode in range(2, 2 + later):
        run_episode(protocol, episode)
    for state in states[:-1]:
        assert protocol.action(answer(state), 1.0) == []  # the same again contradicts nothing
    late = answer(states[28], scale=0.2)
    for harmless in (replace(late, run=RUN + 1), replace(late, plant=1), replace(late, step=31)):
        assert protocol.action(harmless, 1.0) == []
    assert protocol.action(replace(late, values=late.values[:1]), 1.0) == []
    (send,) = protocol.action(late, 1.0)
    assert send.topic is COST
    assert (send.frame.run, send.frame.episode, send.frame.step) == (RUN, 1, cost.step)
    assert (send.frame.values[:, CostColumn.ENDED] == VOID).all()
    assert "two different actions arrived for step 28 of episode 1" in protocol.contradiction
    assert protocol.action(late, 1.0) == []
    run_episode(protocol, 9)
    assert protocol.contradiction == ""


def test_actions_of_the_last_16_episodes_can_be_contradicted_and_of_none_before():
    assert REMEMBERED == 16
    protocol = plant_protocol(horizon=3)
    states = {episode: run_episode(protocol, episode)[0] for episode in range(1, 21)}
    for episode in range(1, 21):
        sent = protocol.action(answer(states[episode], scale=0.2), 1.0)
        assert [(is_void(send), send.frame.episode) for send in sent] == (
            [(True, episode)] if episode > 4 else []
        )


OTHER_STARTS = {
    "other seeds": start(1, seeds=(5, 6)),
    "another signature": replace(start(1), plant=9),
    "both": replace(start(1, seeds=(5, 6)), plant=9),
}


@pytest.mark.parametrize("other", OTHER_STARTS.values(), ids=OTHER_STARTS)
def test_two_different_starts_void_the_episode(other):
    quiet = run_episode(plant_protocol(), 1)
    protocol = plant_protocol()
    (state,) = protocol.start(other, 0.0)  # the first to come is the forged one
    protocol.action(answer(state.frame), 0.0)
    for _ in range(2):
        (void,) = protocol.start(start(1), 0.0)
        assert void.topic is COST
        assert (void.frame.values[:, CostColumn.ENDED] == VOID).all()
    assert protocol.contradiction.startswith("two different starts arrived for episode 1;")
    assert outcome(run_episode(protocol, 2)) == outcome(quiet)


@pytest.mark.parametrize("later", [0, 3])
@pytest.mark.parametrize("other", OTHER_STARTS.values(), ids=OTHER_STARTS)
def test_a_start_that_contradicts_that_of_an_episode_that_ended_takes_its_cost_back(later, other):
    protocol = plant_protocol()
    cost = run_episode(protocol, 1)[-1]
    for episode in range(2, 2 + later):
        run_episode(protocol, episode)
    (send,) = protocol.start(other, 1.0)
    assert send.topic is COST
    assert (send.frame.run, send.frame.episode, send.frame.step) == (RUN, 1, cost.step)
    assert (send.frame.values[:, CostColumn.ENDED] == VOID).all()
    assert "two different starts arrived for episode 1" in protocol.contradiction
    assert (protocol.counters["costs taken back"], protocol.counters["episodes void"]) == (1, 0)
    # Whoever asks again is told the same.
    for asked in (start(1), other):
        again = protocol.start(asked, 1.0)
        assert [found.frame.values.tobytes() for found in again] == (
            [] if later else [send.frame.values.tobytes()]
        )
