# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The checks of stand-ins: this project's nodes pass, and every hidden mistake is named."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from controller_node.identification import DesignSettings
from controller_node.responder import Responder
from loop_interfaces.frames import Frame, FrameError
from loop_interfaces.protocol import Publication
from loop_interfaces.topics import (
    ACTION,
    COST,
    MODEL,
    MODEL_IDENTIFIED,
    PAUSED,
    POLICY,
    START,
    STATE,
    TARGET,
    Topic,
)
from pdeloop.conformance.checks import Check, ControllerCheck, PlantCheck, TunerCheck
from tests.small import parameters
from tests.test_lockstep import plant_protocol
from tuner_node.build import build_training
from tuner_node.dispatch import Dispatcher
from tuner_node.session import Session

Mistake = Callable[[Topic, Frame], Frame]


def none(topic: Topic, frame: Frame) -> Frame:
    return frame


class PureWire:
    """Between a check and a pure protocol, with a mistake in what comes to it or goes from it.

    handlers: what it does with a message at a time; tick: what it does when nothing comes.
    """

    def __init__(self, handlers, tick, heard: Mistake = none, said: Mistake = none) -> None:
        self._handlers, self._tick, self._heard, self._said = handlers, tick, heard, said
        self._inbox: deque[tuple[Topic, Frame]] = deque()
        self._now = 0.0

    def take(self, sends) -> None:
        for send in sends:
            if isinstance(send, tuple):
                send = send[1]
            if isinstance(send, Publication) and send.topic is not PAUSED:
                frame = replace(send.frame, values=send.frame.values.copy())
                self._inbox.append((send.topic, self._said(send.topic, frame)))

    def send(self, topic: Topic, frame: Frame) -> None:
        with suppress(FrameError):
            self.take(self._handlers[topic.name](self._heard(topic, frame), self._now))

    def next(self, *topics: Topic, seconds: float) -> tuple[Topic, Frame] | None:
        for _ in range(6):
            for found in self._inbox:
                if found[0] in topics:
                    self._inbox.remove(found)
                    return found
            self._now += seconds / 5
            self.take(self._tick(self._now))
        return None


def plant(heard: Mistake = none, said: Mistake = none) -> Check:
    protocol = plant_protocol()
    handlers = {START.name: protocol.start, ACTION.name: protocol.action}
    wire = PureWire(handlers, protocol.tick, heard, said)
    wire.take([protocol.announcement()])
    return PlantCheck(wire, 4)


def controller(heard: Mistake = none, said: Mistake = none) -> Check:
    made = Responder(DesignSettings(2, 4, 1.0, 1.0))
    known = (TARGET, made.target), (START, made.start), (POLICY, made.policy)
    known += (MODEL, made.model), (STATE, made.state), (COST, made.cost)
    handlers = {t.name: lambda frame, now, h=handle: h(frame) for t, handle in known}
    return ControllerCheck(PureWire(handlers, lambda now: [], heard, said), 2)


def tuner(heard: Mistake = none, said: Mistake = none) -> Check:
    values = parameters(optimizer="two_point", rollouts=40, seeds=1)
    dispatcher = Dispatcher(
        run=9, n_a=4, pairs=1, incarnation=0, max_batch=1, episode_timeout=9.0, max_attempts=3
    )
    session = Session(build_training(values), dispatcher, lambda row: None)

    def then(event):
        return lambda frame, now: session.advance(event(0, frame, now), now)

    handlers = {
        TARGET.name: then(dispatcher.target),
        COST.name: then(dispatcher.cost),
        MODEL_IDENTIFIED.name: then(dispatcher.model),
    }
    wire = PureWire(handlers, lambda now: session.advance(dispatcher.tick(now), now), heard, said)
    wire.take([*session.begin(0.0), *dispatcher.presence(0, (), 0.0)])
    return TunerCheck(wire, 4)


def bad(check: Check) -> list[str]:
    return [finding.name for finding in check.all() if not finding.good]


@pytest.mark.parametrize("make", [plant, controller, tuner])
def test_the_nodes_of_this_project_keep_to_the_interface(make):
    found = list(make().all())
    assert [finding for finding in found if not finding.good] == []
    assert len(found) >= 5


def changed(on: Topic, change: Callable[[Frame], object]) -> Mistake:
    """Other values, or other ids, in the messages of a topic."""

    def mistake(topic: Topic, frame: Frame) -> Frame:
        if topic is on:
            frame = replace(frame, values=frame.values.copy())
            change(frame)
        return frame

    return mistake


def fixed_seed(frame: Frame) -> None:
    frame.values[:, 0:1] = 3.0


def without_the_last_action(frame: Frame) -> None:
    frame.values[:] *= frame.step != 29


def fixed_excitation(frame: Frame) -> None:
    frame.values[:, 1:2] = np.minimum(frame.values[:, 1:2], 3.0)


def step_0(frame: Frame) -> None:
    frame.step = 0


def zeros(frame: Frame) -> None:
    frame.values[:] = 0.0


@pytest.mark.parametrize(
    ("make", "side", "topic", "mistake", "expected"),
    [
        (plant, "heard", ACTION, without_the_last_action, ["last action"]),
        (plant, "heard", START, fixed_seed, ["seeds"]),
        (plant, "said", STATE, step_0, ["no answer"]),
        (plant, "said", COST, zeros, ["cost", "last action"]),
        (controller, "heard", START, fixed_excitation, ["excitation"]),
        (controller, "said", ACTION, step_0, ["no answer"]),
        (controller, "said", ACTION, zeros, None),
        (tuner, "said", START, step_0, ["policy"]),
    ],
)
def test_a_hidden_mistake_is_named(make, side, topic, mistake, expected):
    found = bad(make(**{side: changed(topic, mistake)}))
    assert found == expected if expected else found
