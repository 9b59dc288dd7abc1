# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The checks of pdeloop.conformance beside pure protocols, with a mistake in what these hear or say."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from controller_node.identification import DesignSettings
from controller_node.responder import Responder
from pdeloop.conformance.controller import ControllerCheck
from pdeloop.conformance.plant import PlantCheck
from pdeloop.conformance.probing import FAILED, Check, Message
from pdeloop.conformance.tuner import TunerCheck
from pdeloop.messages.protocol import ModelFailure, Publication
from pdeloop.messages.topics import (
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
from pdeloop.problem_check import Finding
from tests.support.lockstep import plant_protocol
from tests.support.small import parameters
from tuner_node.batch import DispatchError
from tuner_node.build import build_training
from tuner_node.dispatch import Dispatcher
from tuner_node.session import Session

Mistake = Callable[[Topic, Message], Message]
"""What becomes of a message; None: it is lost, a list: these come in its place."""


class PureTransport:
    """Between a check and a pure protocol. The clock is a number.

    handlers: what it does with a message at a time; tick: what it does when nothing comes; heard,
    said: mistakes in what it hears and says.
    """

    def __init__(
        self,
        handlers: dict[Topic, Callable[[Message, float], Any]],
        tick: Callable[[float], Any],
        heard: Mistake = lambda topic, message: message,
        said: Mistake = lambda topic, message: message,
    ) -> None:
        self._handlers, self._tick, self._heard, self._said = handlers, tick, heard, said
        self._inbox: deque[tuple[Topic, Message]] = deque()
        self._now = 0.0
        self.received_any, self.refused = False, ""

    def take(self, sends: Iterable[Any]) -> None:
        for send in sends:
            send = send[1] if isinstance(send, tuple) else send
            if isinstance(send, Publication) and send.topic is PAUSED:
                continue
            failed = isinstance(send, ModelFailure)
            topic = FAILED if failed else send.topic
            copy = send if failed else replace(send.frame, values=send.frame.values.copy())
            for message in _each(self._said(topic, copy)):
                self.received_any = True
                self._inbox.append((topic, message))

    def now(self) -> float:
        return self._now

    def send(self, topic: Topic, message: Message) -> None:
        for heard in _each(self._heard(topic, message)):
            try:
                self.take(self._handlers[topic](heard, self._now))
            except ValueError:
                pass  # it refuses a message
            except DispatchError:  # it ends
                self._handlers = dict.fromkeys(self._handlers, lambda message, now: [])
                self._tick = lambda now: []

    def next(self, *topics: Topic, seconds: float) -> tuple[Topic, Message] | None:
        self._now += 1e-4
        for _ in range(6):
            for found in self._inbox:
                if found[0] in topics:
                    self._inbox.remove(found)
                    return found
            self._now += seconds / 5
            self.take(self._tick(self._now))
        return None

    def wait_delivered(self) -> None:
        """Nothing is on its way."""

    def disturbance(self, seconds: float = 0.0) -> str:
        return ""


def _each(messages: Any) -> list[Message]:
    if messages is None:
        return []
    return messages if isinstance(messages, list) else [messages]


def plant(parameters: dict[str, Any] | None = None, **mistakes: Mistake) -> Check:
    protocol = plant_protocol(**parameters or {})
    handlers = {START: protocol.start, ACTION: protocol.action}
    transport = PureTransport(handlers, protocol.tick, **mistakes)
    transport.take([protocol.announcement()])
    return PlantCheck(transport, 4)


def controller(settings: dict[str, Any] | None = None, **mistakes: Mistake) -> Check:
    made = Responder(
        DesignSettings(**({"n_a": 2, "reduced_order": 4} | (settings or {})), **WEIGHTS)
    )
    known = (TARGET, made.target), (START, made.start), (POLICY, made.policy)
    known += (MODEL, made.model), (STATE, made.state), (COST, made.cost)
    handlers = {topic: lambda message, now, h=handle: h(message) for topic, handle in known}
    return ControllerCheck(PureTransport(handlers, lambda now: [], **mistakes), 2)


def tuner(options: dict[str, Any] | None = None, **mistakes: Mistake) -> Check:
    values = parameters(
        **({"optimizer": "two_point", "rollouts": 40, "seeds": 1} | (options or {}))
    )
    limits = {"max_batch": 4, "episode_timeout": 600.0, "max_attempts": 5}
    dispatcher = Dispatcher(run=9, n_a=4, pairs=1, incarnation=0, **limits)
    session = Session(build_training(values), dispatcher, lambda row: None)

    def then(event):
        return lambda message, now: session.advance(event(0, message, now), now)

    def tick(now: float):
        over = dispatcher.release() if session.done else []
        return [*session.advance(dispatcher.tick(now), now), *over]

    handlers = {
        TARGET: then(dispatcher.target),
        COST: then(dispatcher.cost),
        MODEL_IDENTIFIED: then(dispatcher.model),
        FAILED: then(dispatcher.failure),
    }
    transport = PureTransport(handlers, tick, **mistakes)
    transport.take([*session.begin(0.0), *dispatcher.presence(0, (), 0.0)])
    return TunerCheck(transport, 4)


WEIGHTS = {"state_weight": 1.0, "action_weight": 1.0}


MAKERS = {"plant": plant, "controller": controller, "tuner": tuner}


def findings(check: Check, *names: str) -> list[Finding]:
    """Those of all probes, or of some."""
    if names:
        check.probes = tuple(p for p in check.probes if p.__name__.replace("_", " ") in names)
        assert len(check.probes) == len(names)
    return list(check.findings())


def named(found: list[Finding]) -> list[str]:
    """The names of what is not simply good, a note in brackets."""
    names = [f"({finding.name})" if finding.note else finding.name for finding in found]
    return [
        name for name, finding in zip(names, found, strict=True) if finding.note or not finding.good
    ]
