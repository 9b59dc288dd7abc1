# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The controller under a law with memory: what was answered stays, and what is not known is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller_node import responder as responder_module
from controller_node.identification import DesignSettings
from controller_node.responder import Responder
from pdeloop.episode import rollout
from pdeloop.in_process import LocalPair
from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.model_rows import unpack
from pdeloop.messages.protocol import ModelFailure
from pdeloop.method.laws import Observer
from tests.support.responding import RUN, start, target
from tests.support.responding import models as affine_models
from tests.support.small import parameters, same_bits
from tuner_node.batch import Batch

SETTINGS = DesignSettings(4, 4, 1.0, 1.0, law="observer", horizon=30)
SEEDS = np.array([3, 8])
ROWS = [(seed, -1, 0, 0) for seed in SEEDS]


def models() -> np.ndarray:
    """Those of the affine law with a filter gain each, which believes half of a measurement."""
    rows = affine_models()
    n_s = rows.shape[2]
    filters = np.vstack([0.5 * np.eye(n_s), np.zeros((1 + 4, n_s))])  # and no d and b
    return np.concatenate([rows, [filters] * len(rows)], axis=1)


def policies() -> np.ndarray:
    law = Observer(unpack(models()[0], 4, True), 30)
    rng = np.random.default_rng(2)
    return np.stack([law.theta_start + 0.1 * rng.standard_normal(law.size) for _ in ROWS])


def begun(episode: int = 1, **settings: object) -> Responder:
    """A controller that was told everything of an episode."""
    made = Responder(replace(SETTINGS, **settings))
    made.target(target())
    made.model(Frame(RUN, 0, 0, 0.0, models()))
    made.policy(Frame(RUN, episode, 0, 0.0, policies()))
    made.start(start(episode, *ROWS))
    return made


def expected() -> tuple[np.ndarray, np.ndarray]:
    """States and actions of the episode in this process."""
    pair = LocalPair(parameters(law="observer"))
    pair.use_models(models())
    law = pair.law(Batch(np.array(ROWS, dtype=float), policies()))
    found = rollout(pair.plant, law, SEEDS)
    return found.states, found.actions


def answer(made: Responder, k: int, states: np.ndarray, episode: int = 1):
    (send,) = made.state(Frame(RUN, episode, k, 0.0, states[k].copy(), 0))
    return send


def test_it_answers_as_in_one_process_whatever_comes_twice() -> None:
    made, (states, actions) = begun(), expected()
    for k in range(len(actions)):
        assert same_bits(answer(made, k, states).frame.values, actions[k])
        made.target(target())  # comes again when a plant joins the network anew
        made.policy(Frame(RUN, 1, 0, 0.0, policies()))
        made.start(start(1, *ROWS))
        assert same_bits(answer(made, k, states).frame.values, actions[k])
    assert same_bits(answer(made, 0, states).frame.values, actions[0])
    assert made.counters["states without the memory before"] == 0


@pytest.mark.parametrize("killed", [1, 17, 30])
def test_a_controller_that_was_killed_asks_for_the_episode_again(killed: int) -> None:
    states, actions = expected()
    made = begun()
    failure = answer(made, killed, states)
    assert isinstance(failure, ModelFailure) and failure.retry
    assert (failure.run, failure.episode) == (RUN, 1)
    assert "the memory of the law 'observer'" in failure.reason
    made.policy(Frame(RUN, 2, 0, 0.0, policies()))
    made.start(start(2, *ROWS))
    for k in range(len(actions)):
        assert same_bits(answer(made, k, states, episode=2).frame.values, actions[k])


def test_the_memory_is_of_the_policy_that_it_was_made_with() -> None:
    """Another episode, policy or target is another memory, which begins at step 0."""
    states, _ = expected()
    made = begun()
    answer(made, 0, states)
    made.target(replace(target(), values=1.1 * target().values))
    assert isinstance(answer(made, 1, states), ModelFailure)


def test_two_states_of_one_step_take_the_episode_back_also_after_its_end() -> None:
    """One of them may be a stranger's, and its answer may have been taken."""
    made, (states, _) = begun(), expected()
    for k in range(len(states)):
        answer(made, k, states)
    failure = answer(made, 3, states + 1e-6)
    assert isinstance(failure, ModelFailure) and not failure.retry
    assert failure.reason.startswith("two different states arrived for step 3")


def test_each_plant_has_a_memory_of_its_own() -> None:
    made, (states, actions) = begun(), expected()
    for k in range(3):
        assert same_bits(answer(made, k, states).frame.values, actions[k])
        made.target(replace(target(), plant=9))
        (other,) = made.state(Frame(RUN, 1, k, 0.0, 0.5 * states[k], 9))
        assert not np.array_equal(other.frame.values, actions[k])


def test_without_room_for_the_answers_only_the_newest_is_kept(monkeypatch) -> None:
    made, (states, actions) = begun(), expected()
    monkeypatch.setattr(responder_module, "MAX_BYTES", 60_000)
    for k in range(len(actions)):
        assert same_bits(answer(made, k, states).frame.values, actions[k])
        assert same_bits(answer(made, k, states).frame.values, actions[k])
    monkeypatch.setattr(responder_module, "MAX_BYTES", 10)
    answer(made, 30, states)
    assert isinstance(answer(made, 5, states), ModelFailure)


def test_gains_of_the_affine_law_are_refused_and_its_own_by_the_affine_controller() -> None:
    words = "expected a policy of the law 'observer', with 2 axes, got one of another law"
    with pytest.raises(FrameError, match=words):
        begun().policy(Frame(RUN, 1, 0, 0.0, np.zeros((2, 4, 8))))
    with pytest.raises(FrameError, match="expected a policy of the law 'affine', with 3 axes"):
        begun(law="affine")
