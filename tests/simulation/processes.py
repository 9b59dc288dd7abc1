# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The processes of a simulated loop: the project's protocols as they are, and strangers."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any
from unittest import mock
from weakref import WeakKeyDictionary

import numpy as np

from controller_node import identification
from controller_node.identification import DesignSettings
from controller_node.responder import Responder
from pde_sim_node.build import build_plant, complete
from pde_sim_node.lockstep import Lockstep
from pde_sim_node.plant import Plant
from pde_sim_node.plants.loading import hand_over
from pde_sim_node.real_time import Timing
from pdeloop.messages.frames import Frame
from pdeloop.messages.problem import load_parameters
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
from pdeloop.method.adapt import ModelBased, RolloutResult
from tests.simulation.disk import Disk
from tests.support.plants import Rods
from tests.support.small import FEW_STEPS, parameters
from tuner_node import training_state
from tuner_node.build import build_dispatcher, build_training
from tuner_node.run_folder import RunIdentity
from tuner_node.session import Session

if TYPE_CHECKING:
    from tests.simulation.history import History

RUN = 7
EVERY_PAIR = -1
"""In place of the pair of a process that gets the messages of all."""


@cache
def values(iterations: int, own_plant: bool, law: str = "affine") -> dict[str, Any]:
    """The parameters of the training: as few and as short episodes as have all of its phases."""
    budget: dict[str, Any] = {"optimizer": "model_based", "rollouts": 9, **FEW_STEPS}
    if iterations:
        budget = {"optimizer": "two_point", "iterations": iterations}
    limits: dict[str, Any] = {
        "law": law,
        "reduced_order": 2,
        "evaluation_fields": 1,
        "identification_attempts": 2,
        "max_attempts": 8,
        "max_batch": 2,
        "episode_timeout": 10.0,
    }
    if own_plant:
        return complete(load_parameters("", {**hand_over(Rods()), **budget, **limits}))[1]
    return parameters(**budget, **limits, n_z=16, n_a=2, horizon=4, integration_time=0.05)


_known: dict[bytes, Any] = {}


@contextmanager
def remembering() -> Iterator[None]:
    """While it lasts, what the method computes from the same numbers is computed once.

    Nearly all histories compute the same, and it is not what they are about.
    """
    own_design = identification.designed
    own_begin, own_tell = ModelBased.__init__, ModelBased.tell
    begun: WeakKeyDictionary[ModelBased, Any] = WeakKeyDictionary()

    def design(*args: Any, **how: Any) -> Any:
        return _once(lambda: own_design(*args, **how), (args, how))

    def begin(self: ModelBased, *args: Any, **how: Any) -> None:
        own_begin(self, *args, **how)
        begun[self] = args, how

    def tell(self: ModelBased, results: Sequence[RolloutResult]) -> Any:
        def told() -> Any:
            return own_tell(self, results), self.state()

        row, state = _once(told, (begun[self], self.state(), results))
        self.restore(state)
        return row

    with (
        mock.patch.object(identification, "designed", design),
        mock.patch.object(ModelBased, "__init__", begin),
        mock.patch.object(ModelBased, "tell", tell),
    ):
        yield


def _once(compute: Callable[[], Any], of: Any) -> Any:
    key = pickle.dumps(of)
    if key not in _known:
        if len(_known) > 1000:
            _known.clear()
        _known[key] = compute()
    return copy.deepcopy(_known[key])


@cache
def _plant(iterations: int, own_plant: bool, name: str) -> tuple[Plant, int]:
    plant = build_plant(values(iterations, own_plant))
    return plant, plant.definition.fingerprint


class Process:
    """What a process is handed, and what it publishes. Dead once `alive` is False.

    name: of the process; role: whose messages it gets; pair: of which pair, unless it is a tuner.
    """

    def __init__(
        self, history: History, name: str, role: str, rate: float = 1.0, pair: int = 0
    ) -> None:
        self.history, self.name, self.role, self.pair = history, name, role, pair
        self.alive, self.stalled = True, 0.0
        self._offset, self._rate = history.rng.uniform(0.0, 1e4), rate

    @property
    def now(self) -> float:
        """Its monotonic clock."""
        return self._offset + self._rate * self.history.time

    def publish(self, publications: Iterable[Publication | ModelFailure]) -> None:
        for sent in publications:
            self.history.network.send(self, sent, self.pair)

    def begin(self) -> None:
        """Say what is said at the start."""

    def tick(self) -> float:
        """Look at the deadlines; seconds until it wants to do so again."""
        return np.inf

    def take(self, topic: Topic, frame: Frame, pair: int) -> None:
        """Handle a message in the namespace of a pair; a ValueError refuses it."""


class PlantProcess(Process):
    def __init__(self, history: History, name: str, rate: float, pair: int) -> None:
        super().__init__(history, name, "plant", rate, pair)
        plant, fingerprint = _plant(history.plan.iterations, history.plan.own_plant, name)
        paused, signed_run = history.records.get(name, (False, 0))
        self.lockstep = Lockstep(
            copy.copy(plant),
            Timing(action_timeout=0.05, max_repeats=100, run_hold=5.0),
            fingerprint=fingerprint,
            paused=paused,
            signed_run=signed_run,
        )
        self._samples: list[tuple[Topic, Frame]] = []

    def begin(self) -> None:
        self._send([self.lockstep.announcement(), self.lockstep.paused_report()])

    def take(self, topic: Topic, frame: Frame, pair: int) -> None:
        if topic is START:
            self._send(self.lockstep.start(frame, self.now))
        else:
            if self.lockstep.awaits(frame):
                self._samples.append((ACTION, frame))
            self._send(self.lockstep.action(frame, self.now))
        self._record()

    def tick(self) -> float:
        self._send(self.lockstep.tick(self.now))
        deadline = self.lockstep.deadline
        return 0.05 if deadline is None else max((deadline - self.now) / self._rate, 1e-3)

    def operate(self, how: str) -> None:
        """Pause, resume or step, as an operator's call."""
        if how == "pause":
            self._send(self.lockstep.pause(self.now))
        elif how == "resume":
            self._send(self.lockstep.resume(self.now))
        else:
            try:
                self._send(self.lockstep.step_once(self.now))
            except ValueError:
                return  # nothing to step, says the answer to the call
        self._record()

    def _record(self) -> None:
        self.history.records[self.name] = self.lockstep.paused, self.lockstep.signed_run

    def _send(self, publications: Iterable[Publication]) -> None:
        """Samples go in one message, before the cost."""
        for sent in publications:
            if sent.topic is STATE:
                values = sent.frame.values.copy()
                self._samples.append((STATE, replace(sent.frame, values=values)))
            elif sent.topic is COST:
                self.history.network.show(self, self._samples)
                self._samples = []
            self.publish([sent])


class ControllerProcess(Process):
    def __init__(
        self, history: History, name: str, rate: float = 1.0, pair: int = 0, **changed: Any
    ) -> None:
        super().__init__(history, name, "controller", rate, pair)
        made = Responder(DesignSettings.of({**history.values, **changed}))
        self._handlers: dict[Topic, Callable[[Frame], Any]] = {
            TARGET: made.target,
            START: made.start,
            POLICY: made.policy,
            MODEL: made.model,
            COST: made.cost,
            STATE: made.state,
        }

    def take(self, topic: Topic, frame: Frame, pair: int) -> None:
        self.publish(self._handlers[topic](frame))


class UnsignedController(ControllerProcess):
    """One that does not sign its actions, as stand-ins may."""

    def publish(self, publications: Iterable[Publication | ModelFailure]) -> None:
        for sent in publications:
            if isinstance(sent, Publication) and sent.topic is ACTION:
                sent = Publication(ACTION, replace(sent.frame, time=0.0))
            super().publish([sent])


class Stranger(Process):
    """Answers every state with zeros and, as stand-ins may, without a signature."""

    def take(self, topic: Topic, frame: Frame, pair: int) -> None:
        if topic is STATE:
            zeros = np.zeros((len(frame.values), self.history.values["n_a"]))
            answer = Frame(frame.run, frame.episode, frame.step, frame.time, zeros, frame.plant)
            self.publish([Publication(ACTION, answer)])


class TunerProcess(Process):
    """A tuner with its disk, from which it goes on.

    power, rot: how its predecessor ended, see Disk.restart.
    """

    def __init__(
        self,
        history: History,
        name: str,
        disk: Disk,
        rate: float = 1.0,
        *,
        run: int = RUN,
        incarnation: int = 0,
        power: bool = False,
        rot: bool = False,
    ) -> None:
        super().__init__(history, name, "tuner", rate, EVERY_PAIR)
        given = {**history.values, "pairs": [""] * history.plan.pairs}
        training = build_training(given)
        disk.restart(partial(training_state.restore, training), power=power, rot=rot)
        self._disk = disk
        self.dispatcher = build_dispatcher(given, training, RunIdentity(run, incarnation))
        self._changed = False
        self.session = Session(training, self.dispatcher, self._report)

    def begin(self) -> None:
        self._guarded(self.session.begin)

    def take(self, topic: Topic, frame: Frame, pair: int) -> None:
        handler = {
            COST: self.dispatcher.cost,
            MODEL_IDENTIFIED: self.dispatcher.model,
            TARGET: self.dispatcher.target,
            PAUSED: self.dispatcher.plant_paused,
        }[topic]
        self._guarded(lambda now: handler(pair, frame, now))

    def see(self, samples: list[tuple[Topic, Frame]], pair: int) -> None:
        """Take samples of an episode."""
        for topic, frame in samples:
            if topic is ACTION:
                self.dispatcher.action(pair, frame)
            elif self.dispatcher.state(pair, frame):
                self._guarded(self.dispatcher.tick)

    def fail(self, failure: ModelFailure, pair: int) -> None:
        self._guarded(lambda now: self.dispatcher.failure(pair, failure, now))

    def tick(self) -> float:
        for pair in range(self.history.plan.pairs):
            missing = self.history.missing(pair)
            self._guarded(lambda now, p=pair, m=missing: self.dispatcher.presence(p, m, now))
        self._guarded(self.dispatcher.tick)
        return 0.1

    def operate(self, how: str) -> None:
        """Pause, resume or stop, as an operator's call."""
        if how == "pause":
            self.dispatcher.pause()
        elif how == "resume":
            self._guarded(self.dispatcher.resume)
        else:
            self._guarded(lambda now: self.session.stop())

    def _guarded(self, event: Callable[[float], Any]) -> None:
        """As the node does it: perform, send, then keep."""
        session = self.session
        if session.done or session.stopped:
            return
        sent = session.advance(event(self.now), self.now)
        for pair, publication in sent:
            self.history.network.send(self, publication, pair)
        if self._changed and (session.stopped or self.history.rng.random() < 0.5):
            self._disk.save(training_state.arrays_of(session.training))
            self._changed = False

    def _report(self, row: Any) -> None:
        self._changed = True
        self.history.rows.append(row)
