# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The controller's protocol: answers are pure, and what is missing is said, never guessed."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from controller_node.identification import DesignSettings
from controller_node.policy import excitation
from controller_node.responder import Responder
from controller_node.run_state import MAX_RUNS, Models, RunState, forget
from loop_interfaces import model_rows
from loop_interfaces.frames import Frame, FrameError
from loop_interfaces.protocol import ModelFailure
from loop_interfaces.topics import ACTION, COMPLETED, MODEL_IDENTIFIED, VOID, CostColumn
from pde_sim_node.build import build_plant
from pde_sim_node.plants import SpectralPlant
from pdeloop.in_process import LocalPair
from tests.support.small import parameters, same_bits
from tuner_node.batch import Batch

RUN = 5
COSTS = np.array([[1.0, 30.0, COMPLETED]])
SETTINGS = DesignSettings(n_a=4, reduced_order=4, state_weight=1.0, action_weight=1.0)


@cache
def plant() -> SpectralPlant:
    return build_plant(parameters())


def target() -> Frame:
    return Frame(0, 0, 0, 0.0, plant().target)


@pytest.fixture
def responder() -> Responder:
    """A controller that knows the target."""
    made = Responder(SETTINGS)
    made.target(target())
    return made


def start(episode: int, *rows: tuple[float, ...], run: int = RUN) -> Frame:
    return Frame(run, episode, 0, 0.0, np.array(rows, dtype=float).reshape(-1, 4))


def models() -> np.ndarray:
    found = LocalPair(parameters()).run(Batch(np.array([(1.0, 2.0, 0.1, 0.0)]), None)).models
    assert found is not None
    return found


def explore(responder: Responder, episode: int, excitation_seed: int = 2, lose: int = -1):
    """Drive an exploratory episode; the state of step `lose` never reaches the controller."""
    responder.start(start(episode, (1, excitation_seed, 0.1, 0)))
    states = plant().reset(np.array([1]))
    for k in range(plant().horizon + 1):
        if k != lose:
            (send,) = responder.state(Frame(RUN, episode, k, 0.0, states))
            expected = excitation(excitation_seed, k, 4, 0.1)
            assert same_bits(send.frame.values[0], expected)
        if k < plant().horizon:
            states = plant().step(excitation(excitation_seed, k, 4, 0.1)[np.newaxis])
    return responder.cost(Frame(RUN, episode, plant().horizon, 1.0, COSTS))


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
    free, limited = (Responder(replace(SETTINGS, action_limit=limit)) for limit in (0.0, 0.05))
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


def test_states_of_two_plants_are_not_mixed_into_one_model(responder):
    responder.target(Frame(0, 0, 0, 0.0, plant().target, plant=9))
    responder.start(start(1, (1, 2, 0.1, 0)))
    stranger = np.random.default_rng(0).standard_normal((1, 32))
    for k in range(31):
        (send,) = responder.state(Frame(RUN, 1, k, 0.0, stranger, plant=9))
        assert send.frame.plant == 9
    (send,) = explore(responder, 1)
    assert same_bits(send.frame.values, models())


def test_a_flood_of_strangers_does_not_push_out_the_run_that_is_served(responder):
    responder.start(start(1, (1, 9, 0.1, 0)))
    state = Frame(RUN, 1, 0, 0.0, plant().reset(np.array([1])).copy())
    (before,) = responder.state(state)
    for stranger in range(100, 200):
        responder.start(start(1, (1, 9, 0.1, 0), run=stranger))
        responder.target(Frame(0, 0, 0, 0.0, np.ones(2), plant=stranger))
    (after,) = responder.state(state)
    assert same_bits(after.frame.values, before.frame.values)


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


def test_a_run_of_a_stranger_fills_no_memory(responder, monkeypatch):
    monkeypatch.setattr("controller_node.responder.MAX_BYTES", 100_000)
    states = plant().reset(np.array([1]))
    for run in range(100, 120):
        responder.start(start(1, (1, 2, 0.1, 0), run=run))
        for k in range(2000):
            assert len(responder.state(Frame(run, 1, k, 0.0, states + k))) == 1
        assert sum(known.nbytes for known in responder._runs.values()) <= 100_000
    (failure,) = responder.cost(Frame(119, 1, 1999, 1.0, COSTS))
    assert isinstance(failure, ModelFailure) and not failure.retry
    assert "more than 100000 bytes; explore fewer seeds at once" in failure.reason
    with pytest.raises(FrameError, match="expected less than 100000 bytes of all runs"):
        responder.policy(Frame(7, 1, 0, 0.0, np.ones((50, 4, 80))))
    (model,) = explore(responder, 5)  # the run with room is served as before
    assert model.topic is MODEL_IDENTIFIED


def test_targets_of_ever_new_plants_fill_no_memory(responder, monkeypatch):
    monkeypatch.setattr("controller_node.responder.MAX_BYTES", 100_000)
    explore(responder, 1)  # so that the plant of the run is known
    served = set(responder._targets)
    for number in range(1000, 1020):
        responder.target(Frame(0, 0, 0, 0.0, np.ones(3000), plant=number))
        assert sum(target.nbytes for target in responder._targets.values()) <= 50_000
    assert served < set(responder._targets)


def test_states_of_one_number_count_with_what_keeps_them(responder, monkeypatch):
    monkeypatch.setattr("controller_node.responder.MAX_BYTES", 100_000)
    responder.start(start(1, (1, 2, 0.1, 0)))
    for k in range(400):
        responder.state(Frame(RUN, 1, k, 0.0, np.ones((1, 1))))
    (failure,) = responder.cost(Frame(RUN, 1, 399, 1.0, COSTS))
    assert "more than 100000 bytes" in failure.reason


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


def test_of_two_different_states_that_wait_neither_is_answered(responder):
    state = Frame(RUN, 1, 0, 0.0, plant().reset(np.array([1])))
    assert responder.state(state) == responder.state(replace(state, values=state.values + 1)) == []
    assert responder.start(start(1, (1, 2, 0.1, 0))) == []
    assert len(responder.state(state)) == 1


def test_an_exploration_waits_for_its_start_and_the_target_alone():
    made = Responder(SETTINGS)
    state = Frame(RUN, 1, 0, 0.0, plant().reset(np.array([1])).copy())
    assert made.waits_for() == [] and made.state(state) == []
    assert made.waits_for() == ["episode/start", "target"]
    made.start(start(1, (1, 2, 0.1, 0)))
    assert made.waits_for() == ["target"]
    assert len(made.target(target())) == 1 and made.waits_for() == []


def test_while_another_state_waits_nothing_is_answered_without_being_looked_at(responder):
    responder.policy(Frame(RUN, 4, 1, 0.0, np.full((1, 4, 8), 0.1)))
    responder.model(Frame(RUN, 0, 1, 0.0, models()))
    responder.start(replace(start(4, (1, -1, 0.0, 0)), step=1))
    state = Frame(RUN, 4, 0, 0.0, plant().reset(np.array([1])).copy())
    assert len(responder.state(state)) == 1 and responder.answering(state) is not None
    assert responder.under_way
    assert responder.state(replace(state, episode=5)) == []
    assert responder.answering(state) is None


def test_of_more_runs_than_are_kept_the_least_recently_used_one_goes():
    known = OrderedDict((number, number) for number in range(MAX_RUNS))
    forget(known, 3, 0)
    assert list(known) == [*(n for n in range(MAX_RUNS) if n != 3), 3]
    known[77] = 77
    forget(known, 77, 0)
    assert list(known) == [0, *(n for n in range(2, MAX_RUNS) if n != 3), 3, 77]
    forget(known, 77, 0, full=lambda: len(known) > 3)
    assert list(known) == [0, 3, 77]


def test_a_run_takes_the_bytes_of_all_that_is_kept_of_it():
    one = Frame(RUN, 1, 0, 0.0, np.ones((1, 4)))
    state = RunState(start=one)
    state.policies.append(replace(one, values=np.ones((1, 4, 8))))
    assert state.nbytes == 8 * (4 + 32)
    state.laws[3] = ((1,), SimpleNamespace(nbytes=1000))
    state.exploration = SimpleNamespace(nbytes=500)
    assert state.nbytes == 8 * (4 + 32) + 1500
    model = SimpleNamespace(U=np.ones((9, 2)), A=np.ones((2, 2)), B=np.ones((2, 3)))
    state.models.append(Models(1, 7, [SimpleNamespace(model=model)]))  # the law copies them
    assert state.nbytes == 8 * (4 + 32) + 1500 + 2 * 8 * (18 + 4 + 6)


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
