# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training held, stopped and continued by an operator: the same policy, to the bit."""

from __future__ import annotations

from functools import cache

import pytest

from pdeloop.in_process import LocalPair
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import MODEL, POLICY, START, StartColumn
from tests.support.small import dispatcher_of, parameters, same_bits, train_here
from tuner_node import training_state
from tuner_node.batch import Batch, DispatchError
from tuner_node.build import build_training
from tuner_node.session import Session
from tuner_node.training import Training

ITERATIONS = 5


@cache
def values():
    return parameters(iterations=ITERATIONS, seeds=2)


@cache
def undisturbed() -> Training:
    return train_here(values())


class Loop:
    """A session and a plant and controller that answer its publications, one episode a call."""

    def __init__(self, training: Training, incarnation: int = 0) -> None:
        dispatcher = dispatcher_of(n_a=values()["n_a"], incarnation=incarnation)
        self.rows: list = []
        self.now = 0.0
        self.session = Session(training, dispatcher, self.rows.append)
        self.pair = LocalPair(values())
        self.plant = 1
        self.policy = None
        self.start: Frame | None = None
        self.released = False
        self.take(self.session.begin(self.now))
        self.handle(dispatcher.presence(0, (), self.now))

    def handle(self, publications) -> None:
        """What the dispatcher answers an event with."""
        self.take(self.session.advance(publications, self.now))

    def take(self, publications) -> None:
        for _, send in publications:
            if send.topic is MODEL:
                self.pair.use_models(send.frame.values)
            elif send.topic is POLICY:
                self.policy = send.frame.values
            elif send.topic is START and not len(send.frame.values):
                self.released = True
            elif send.topic is START:
                self.start = send.frame

    def episode(self) -> None:
        """Answer the last start."""
        self.now += 1.0
        dispatcher = self.session.dispatcher
        frame, self.start = self.start, None
        exploring = frame.values[0, StartColumn.EXCITATION] >= 0
        result = self.pair.run(Batch(frame.values, None if exploring else self.policy))

        def answer(array):
            return Frame(frame.run, frame.episode, 30, self.now, array, self.plant)

        self.handle(dispatcher.cost(0, answer(result.costs), self.now))
        if result.models is not None:
            self.handle(dispatcher.model(0, answer(result.models), self.now))

    def iterations(self) -> int:
        return sum(row["event"] == "adapted" for row in self.rows) // 2


def same(a: Training, b: Training) -> bool:
    return same_bits(a.policies(), b.policies()) and same_bits(a.evaluation, b.evaluation)


def test_a_paused_session_begins_no_episode_and_goes_on_with_the_same_bits():
    loop = Loop(build_training(values()))
    while not loop.session.done:
        loop.session.dispatcher.pause()
        loop.episode()
        if loop.session.done:
            break
        assert loop.start is None
        loop.now += 1000.0
        # Keeps the plant: the last start, once more.
        loop.handle(loop.session.dispatcher.tick(loop.now))
        loop.start = None
        loop.handle(loop.session.dispatcher.resume(loop.now))
        assert loop.start is not None
    assert same(loop.session.training, undisturbed())
    assert not [row for row in loop.rows if row["event"] == "repeated"]


def test_what_a_tuner_reports_of_a_session_begins_with_nothing_and_has_the_measured_baselines():
    loop = Loop(build_training(values()))
    assert not loop.session.established and loop.session.baseline("lqt") is None
    loop.episode()
    assert loop.session.established
    while not any(row["event"] == "adapted" for row in loop.rows):
        loop.episode()
    for name in ("none", "lqt"):
        measured = [row[name] for row in loop.rows if row["event"] == "checked"]
        assert len(measured) == 2
        assert loop.session.baseline(name) == pytest.approx(sum(measured) / 2)


@pytest.mark.parametrize("after", range(1, 30, 4))
def test_a_session_that_was_asked_to_stop_ends_with_its_iteration_and_can_be_continued(after):
    loop = Loop(build_training(values()))
    for _ in range(after):
        loop.episode()
        if loop.session.done:
            break
    done = loop.iterations()
    loop.take(loop.session.stop())
    while not (loop.session.stopped or loop.session.done):
        loop.episode()
    assert loop.iterations() <= done + 1
    assert loop.released == loop.session.stopped
    continued = build_training(values())
    training_state.restore(continued, training_state.arrays_of(loop.session.training))
    again = Loop(continued, incarnation=1)
    while not again.session.done:
        again.episode()
    assert same(again.session.training, undisturbed())


def test_a_session_that_joined_the_network_again_asks_for_what_is_under_way():
    loop = Loop(build_training(values()))
    start, loop.start = loop.start, None
    assert start is not None
    loop.take(loop.session.begin(5.0))
    assert loop.start is not None
    assert loop.start.episode == start.episode and same_bits(loop.start.values, start.values)


def test_a_result_that_the_training_cannot_use_ends_it_with_its_sentence():
    loop = Loop(build_training(values()))
    loop.session.training.plant = 2  # the run was begun with another one
    with pytest.raises(DispatchError, match="the plant has other parameters"):
        loop.episode()


def test_stopping_a_paused_session_ends_it_at_once():
    loop = Loop(build_training(values()))
    for _ in range(6):
        loop.episode()
    loop.session.dispatcher.pause()
    loop.take(loop.session.stop())
    assert loop.session.stopped
    assert loop.released
