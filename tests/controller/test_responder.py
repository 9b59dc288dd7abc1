# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The controller's protocol: answers are pure, and what is missing is said, never guessed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller_node.responder import Responder
from pdeloop.messages import model_rows
from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.topics import ACTION
from tests.support.responding import RUN, SETTINGS, models, plant, start, target
from tests.support.small import same_bits


def test_the_law_is_answered_whatever_the_order_in_which_its_parts_arrive():
    rows = models()
    policy = model_rows.unpack(rows[0], 4).policy
    state = Frame(RUN, 3, 0, 0.0, plant().reset(np.array([1, 2])).copy())
    parts = {
        "start": start(3, (1, -1, 0, 0), (2, -1, 0, 0)),
        "policy": Frame(RUN, 3, 0, 0.0, np.stack([policy, 0 * policy])),
        "model": Frame(RUN, 0, 0, 0.0, rows),
        "target": target(),
        "state": state,
    }
    answers = []
    for order in (
        ("start", "policy", "model", "target", "state"),
        ("state", "target", "model", "policy", "start"),
        ("model", "state", "start", "target", "policy"),
    ):
        responder = Responder(SETTINGS)
        sends = [send for name in order for send in getattr(responder, name)(parts[name])]
        assert [send.topic for send in sends] == [ACTION]
        answers.append(sends[0].frame)
        (again,) = responder.state(state)
        assert same_bits(again.frame.values, answers[0].values)
    assert all(same_bits(a.values, answers[0].values) for a in answers)
    s = model_rows.unpack(rows[0], 4)
    expected = s.K_a @ (s.U.T @ state.values[0]) + s.K_b @ (s.U.T @ plant().target)
    assert np.allclose(answers[0].values[0], expected, rtol=1e-12, atol=1e-13)
    assert (answers[0].values[1] == 0).all()


def test_each_of_two_plants_is_answered_with_its_own_target(responder):
    responder.target(Frame(0, 0, 0, 0.0, plant().target + 1.0, plant=9))
    responder.model(Frame(RUN, 0, 0, 0.0, models()))
    responder.policy(Frame(RUN, 4, 0, 0.0, np.full((1, 4, 8), 0.2)))
    responder.start(start(4, (1, -1, 0, 0)))
    states = plant().reset(np.array([1])).copy()
    answers = [
        [responder.state(Frame(RUN, 4, k, 0.0, states, p))[0].frame.values.copy() for p in (0, 9)]
        for k in range(2)
    ]
    assert not same_bits(*answers[0])
    assert all(same_bits(a, b) for a, b in zip(*answers, strict=True))


def test_a_state_of_another_episode_or_run_is_not_answered(responder):
    responder.start(start(1, (1, 9, 0.1, 0)))
    state = plant().reset(np.array([1]))
    assert responder.state(Frame(RUN, 2, 0, 0.0, state)) == []
    assert responder.state(Frame(RUN + 1, 1, 0, 0.0, state)) == []
    assert len(responder.state(Frame(RUN, 1, 0, 0.0, state))) == 1


def test_a_policy_waits_for_the_models_it_belongs_to():
    rows = models()
    policy = model_rows.unpack(rows[0], 4).policy
    state = Frame(RUN, 3, 0, 0.0, plant().reset(np.array([1])).copy())
    responder = Responder(SETTINGS)
    responder.target(target())
    responder.model(Frame(RUN, 0, 1, 0.0, 2.0 * rows))  # of the identification that was thrown away
    responder.start(Frame(RUN, 3, 2, 0.0, np.array([[1.0, -1.0, 0.0, 0.0]])))
    assert responder.policy(Frame(RUN, 3, 2, 0.0, policy[np.newaxis])) == []
    assert responder.state(state) == []
    assert responder.waits_for() == ["model"]
    (send,) = responder.model(Frame(RUN, 0, 2, 0.0, rows))
    s = model_rows.unpack(rows[0], 4)
    expected = s.K_a @ (s.U.T @ state.values[0]) + s.K_b @ (s.U.T @ plant().target)
    assert np.allclose(send.frame.values[0], expected, rtol=1e-12, atol=1e-13)


def test_two_runs_are_answered_side_by_side_and_forgotten_when_released(responder):
    state = plant().reset(np.array([1])).copy()
    responder.start(start(1, (1, 9, 0.1, 0)))
    responder.start(start(1, (1, 10, 0.1, 0), run=6))
    (a,) = responder.state(Frame(RUN, 1, 0, 0.0, state))
    (b,) = responder.state(Frame(6, 1, 0, 0.0, state))
    assert not np.array_equal(a.frame.values, b.frame.values)
    responder.start(start(0, run=6))
    assert responder.state(Frame(6, 1, 0, 0.0, state)) == []
    assert len(responder.state(Frame(RUN, 1, 0, 0.0, state))) == 1


@pytest.mark.parametrize(
    ("name", "frame", "words"),
    [
        (
            "start",
            start(1, (1, 2, 0.1, 0), (1, -1, 0, 0)),
            "all environments of an episode to explore",
        ),
        ("start", start(1, (1, -1, 0, -1)), "model indices"),
        ("start", start(1, (1, 2, -0.1, 0)), "variances"),
        ("start", Frame(RUN, 1, 0, 0.0, np.zeros((2, 2))), "rows of 4"),
        ("policy", Frame(RUN, 1, 0, 0.0, np.zeros((1, 3, 8))), "4 actuators"),
        ("policy", Frame(RUN, 1, 0, 0.0, np.full((1, 4, 8), 1e12)), "at most 1e"),
        ("model", Frame(RUN, 0, 0, 0.0, np.zeros((1, 9, 4))), "leaves"),
    ],
)
def test_malformed_messages_are_refused(name, frame, words):
    with pytest.raises(ValueError, match=words):
        getattr(Responder(SETTINGS), name)(frame)


def test_a_policy_that_does_not_fit_the_episode_is_refused_and_a_good_one_serves_later():
    responder = Responder(SETTINGS)
    rows = models()
    policy = model_rows.unpack(rows[0], 4).policy
    responder.target(target())
    responder.model(Frame(RUN, 0, 0, 0.0, rows))
    responder.start(start(1, (1, -1, 0, 0)))
    responder.policy(Frame(RUN, 1, 0, 0.0, np.stack([policy, policy])))
    state = Frame(RUN, 1, 0, 0.0, plant().reset(np.array([1])).copy())
    with pytest.raises(FrameError, match="policies for 1 environments, got 2"):
        responder.state(state)
    responder.policy(Frame(RUN, 1, 0, 0.0, policy[np.newaxis]))
    assert len(responder.state(state)) == 1


def test_of_two_different_states_that_wait_neither_is_answered(responder):
    state = Frame(RUN, 1, 0, 0.0, plant().reset(np.array([1])))
    assert responder.state(state) == responder.state(replace(state, values=state.values + 1)) == []
    assert responder.start(start(1, (1, 2, 0.1, 0))) == []
    assert len(responder.state(state)) == 1


def test_while_another_state_waits_nothing_is_answered_without_being_looked_at(responder):
    responder.policy(Frame(RUN, 4, 1, 0.0, np.full((1, 4, 8), 0.1)))
    responder.model(Frame(RUN, 0, 1, 0.0, models()))
    responder.start(replace(start(4, (1, -1, 0.0, 0)), step=1))
    state = Frame(RUN, 4, 0, 0.0, plant().reset(np.array([1])).copy())
    assert len(responder.state(state)) == 1 and responder.answering(state) is not None
    assert responder.under_way
    assert responder.state(replace(state, episode=5)) == []
    assert responder.answering(state) is None


@pytest.mark.parametrize("what", ["policy", "model"])
def test_without_signatures_an_episode_with_two_different_policies_or_models_is_not_answered(
    responder, what
):
    told = {
        "policy": Frame(RUN, 4, 1, 0.0, np.full((1, 4, 8), 0.1)),
        "model": Frame(RUN, 0, 1, 0.0, models()),
    }
    state = Frame(RUN, 4, 0, 0.0, plant().reset(np.array([1])).copy())
    handlers = {"policy": responder.policy, "model": responder.model}
    begin = replace(start(4, (1, -1, 0.0, 0)), step=1)
    for name, handle in handlers.items():
        handle(told[name])
    responder.start(begin)
    assert handlers[what](told[what]) == []
    assert len(responder.state(state)) == 1
    with pytest.raises(FrameError, match=r"two different .* arrived .*; expected one tuner"):
        handlers[what](replace(told[what], values=1.5 * told[what].values))
    assert responder.state(state) == [] and responder.answering(state) is None
    assert responder.waits_for() == ["one tuner (different policies or models arrived)"]
    # Those of the next one are in no doubt.
    responder.policy(replace(told["policy"], episode=5, step=2))
    responder.model(replace(told["model"], step=2))
    responder.start(replace(begin, episode=5, step=2))
    assert len(responder.state(replace(state, episode=5))) == 1
