"""One training over a simulated network, from its plan."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterable
from copy import deepcopy
from functools import cache
from typing import Any

import numpy as np

from controller_node.identification import DesignSettings
from controller_node.responder import Responder
from loop_interfaces.frames import ArrayCodec, Frame, FrameError
from loop_interfaces.protocol import ModelFailure, Publication
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
from pde_sim_node.build import build_plant, fingerprint
from pde_sim_node.lockstep import Lockstep, Timing
from tests.simulation.plan import PROCESSES, Fault, Plan
from tests.small import parameters
from tuner_node.build import build_training
from tuner_node.dispatch import Dispatcher, DispatchError
from tuner_node.session import Session
from tuner_node.training import Training

RUN = 7
LEASE = 3.0
"""Seconds after which a process that has gone is missed."""
LIMIT = 3600.0
"""Virtual seconds in which every training ends."""
TICK = {"plant": 0.01, "controller": 0.05, "tuner": 0.05}
"""Seconds between two looks of a process at its deadlines."""
READERS: dict[Topic, tuple[str, ...]] = {
    START: ("plant", "controller"),
    POLICY: ("controller",),
    MODEL: ("controller",),
    STATE: ("controller",),
    COST: ("controller", "tuner"),
    ACTION: ("plant",),
    MODEL_IDENTIFIED: ("tuner",),
    TARGET: ("controller", "tuner"),
    PAUSED: ("tuner",),
}


@cache
def values(trajectories: bool) -> dict[str, Any]:
    """The parameters of the training."""
    budget = {"optimizer": "gauss_newton", "rollouts": 9} if trajectories else {"iterations": 2}
    return parameters(**budget, evaluation_fields=2, max_attempts=8)


class Process:
    """A process of the loop: what it is handed, and what it publishes. Ends by being replaced."""

    def __init__(self, history: History, name: str, rate: float, writer: str = "") -> None:
        self.history, self.name, self.writer = history, name, writer or name
        self.alive = True
        self._offset, self._rate = history.rng.uniform(0.0, 1e4), rate

    @property
    def now(self) -> float:
        """Its monotonic clock."""
        return self._offset + self._rate * self.history.time

    def publish(self, publications: Iterable[Publication | ModelFailure]) -> None:
        for sent in publications:
            if isinstance(sent, Publication):
                self.history.send(self, sent.topic, sent.frame)
            else:
                self.history.tell(self, sent)

    def tick(self) -> None:
        """Look at the deadlines."""

    def take(self, topic: Topic, frame: Frame) -> None:
        """Handle a message; a FrameError refuses it."""


class PlantProcess(Process):
    def __init__(self, history: History, rate: float) -> None:
        super().__init__(history, "plant", rate)
        given = history.values
        self.lockstep = Lockstep(
            build_plant(given),
            Timing(action_timeout=0.05, max_repeats=100, run_hold=5.0),
            fingerprint=fingerprint(given),
            paused_run=history.disk.get("pause", 0),
        )
        self._samples: list[tuple[Topic, bytes]] = []
        self._send([self.lockstep.announcement(), self.lockstep.paused_report()])

    def take(self, topic: Topic, frame: Frame) -> None:
        if topic is START:
            self._send(self.lockstep.start(frame, self.now))
        else:
            taken = self.lockstep.awaits(frame)
            sends = self.lockstep.action(frame, self.now)
            if taken:
                self._samples.append((ACTION, self.history.encoded(ACTION, frame)))
            self._send(sends)
        self._record_pause()

    def tick(self) -> None:
        self._send(self.lockstep.tick(self.now))

    def pause(self, on: bool) -> None:
        change = self.lockstep.pause if on else self.lockstep.resume
        self._send(change(self.now))
        self._record_pause()

    def _record_pause(self) -> None:
        self.history.disk["pause"] = self.lockstep.run if self.lockstep.paused else 0

    def _send(self, publications: Iterable[Publication]) -> None:
        """Samples go in one message, before the cost."""
        for sent in publications:
            if sent.topic is STATE:
                self._samples.append((STATE, self.history.encoded(STATE, sent.frame)))
            elif sent.topic is COST:
                self.history.show(self, self._samples)
                self._samples = []
            self.publish([sent])


class ControllerProcess(Process):
    def __init__(self, history: History, rate: float, writer: str = "", **changed: Any) -> None:
        super().__init__(history, "controller", rate, writer)
        self.responder = responder = Responder(DesignSettings.of({**history.values, **changed}))
        self._handlers: dict[Topic, Callable[[Frame], Any]] = {
            TARGET: responder.target,
            START: responder.start,
            POLICY: responder.policy,
            MODEL: responder.model,
            COST: responder.cost,
            STATE: responder.state,
        }

    def take(self, topic: Topic, frame: Frame) -> None:
        self.publish(self._handlers[topic](frame))


class Stranger(Process):
    """Answers every state with zeros and, as stand-ins may, without a signature."""

    def take(self, topic: Topic, frame: Frame) -> None:
        if topic is STATE:
            zeros = np.zeros((len(frame.values), self.history.values["n_a"]))
            answer = Frame(frame.run, frame.episode, frame.step, frame.time, zeros, frame.plant)
            self.publish([Publication(ACTION, answer)])


class SecondTuner(Process):
    """Wants the plant for a run of its own, again and again."""

    def tick(self) -> None:
        rows = np.array([[1.0, 2.0, 0.1, 0.0]])
        self.publish([Publication(START, Frame(RUN + 1, 1, 0, 0.0, rows))])


class TunerProcess(Process):
    def __init__(self, history: History, rate: float) -> None:
        super().__init__(history, "tuner", rate)
        training = build_training(history.values)
        if "checkpoint" in history.disk:
            training.restore(deepcopy(history.disk["checkpoint"]))
        incarnation = history.disk["starts"] = history.disk.get("starts", -1) + 1
        self.dispatcher = Dispatcher(
            run=RUN,
            n_a=history.values["n_a"],
            pairs=1,
            incarnation=incarnation,
            max_batch=4,
            episode_timeout=10.0,
            max_attempts=history.values["max_attempts"],
            plant=training.plant,
            action_limit=history.values["action_limit"],
        )
        self.session = Session(training, self.dispatcher, self._report)
        self._guarded(self.session.begin)

    def take(self, topic: Topic, frame: Frame) -> None:
        handler = {
            COST: self.dispatcher.cost,
            MODEL_IDENTIFIED: self.dispatcher.model,
            TARGET: self.dispatcher.target,
            PAUSED: self.dispatcher.plant_paused,
        }[topic]
        self._guarded(lambda now: handler(0, frame, now))

    def see(self, samples: list[tuple[Topic, Frame]]) -> None:
        """Take samples of an episode."""
        for topic, frame in samples:
            if topic is ACTION:
                self.dispatcher.action(0, frame)
            elif self.dispatcher.state(0, frame):
                self._guarded(self.dispatcher.tick)

    def fail(self, failure: ModelFailure) -> None:
        self._guarded(lambda now: self.dispatcher.failure(0, failure, now))

    def tick(self) -> None:
        missing = [n for n in ("plant", "controller") if not self.history.present(n)]
        self._guarded(lambda now: self.dispatcher.presence(0, missing, now))
        self._guarded(self.dispatcher.tick)

    def hold(self, on: bool) -> None:
        if on:
            self.dispatcher.pause()
        else:
            self._guarded(self.dispatcher.resume)

    def _guarded(self, event: Callable[[float], Any]) -> None:
        sent = self.session.advance(event(self.now), self.now) if not self.session.done else []
        self.publish(publication for _, publication in sent)

    def _report(self, row: Any) -> None:
        self.history.rows.append(row)

    def save(self) -> None:
        """Write a checkpoint, which may not reach the disk before a crash."""
        if self.history.rng.random() < self.history.plan.saved:
            self.history.disk["checkpoint"] = deepcopy(self.session.training.state())


class History:
    """What happens. `run` gives the finished training, or the error with which the tuner ended."""

    def __init__(self, plan: Plan) -> None:
        self.plan, self.values = plan, values(plan.trajectories)
        self.rng = np.random.default_rng((plan.seed, 1))
        self.time = 0.0
        self.rows: list[Any] = []
        self.refused: list[str] = []
        self.disk: dict[str, Any] = {}
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._codecs = {topic: ArrayCodec(topic.labels) for topic in READERS}
        self._latched: dict[tuple[str, Topic], bytes] = {}
        self._cut: set[tuple[str, str]] = set()
        self._gone: dict[str, float] = {}
        self._rates = dict(zip(PROCESSES, plan.rates, strict=True))
        self._strangers: list[Process] = []
        self._processes: dict[str, Process] = {}
        for name in PROCESSES:
            self._start(name)
        for name, period in TICK.items():
            self._repeat(name, period)
        for fault in plan.faults:
            self._at(fault.time, lambda fault=fault: self._happen(fault))

    def run(self) -> Training | DispatchError:
        """TimeoutError if the training does not end in `LIMIT` virtual seconds."""
        while self.time < LIMIT:
            self.time, _, event = heapq.heappop(self._events)
            try:
                event()
            except DispatchError as error:
                return error
            tuner = self._processes.get("tuner")
            if isinstance(tuner, TunerProcess):
                if tuner.session.done:
                    return tuner.session.training
                tuner.save()
        raise TimeoutError(f"no end within {LIMIT:g} virtual seconds")

    def send(self, writer: Process, topic: Topic, frame: Frame) -> None:
        """Bring a message to who reads its topic, as the network at that moment does."""
        raw = self.encoded(topic, frame)
        if topic.latched:
            self._latched[writer.writer, topic] = raw
        for reader in READERS[topic]:
            for _ in range(1 + (not topic.latched and self.rng.random() < self.plan.duplicates)):
                if topic.latched or self.rng.random() >= self.plan.loss:
                    self._carry(writer.name, reader, topic, raw)

    def tell(self, writer: Process, failure: ModelFailure) -> None:
        """Bring a failure to the tuner."""
        text = failure.to_json()
        self._at(self._later(), lambda: self._tuner(lambda t: t.fail(ModelFailure.from_json(text))))

    def encoded(self, topic: Topic, frame: Frame) -> bytes:
        """The bytes of a frame on the wire."""
        return self._codecs[topic].encode(frame)

    def show(self, plant: Process, samples: list[tuple[Topic, bytes]]) -> None:
        """Bring the samples of an episode to the tuner, if it reads them."""
        if not self.plan.trajectories or (plant.name, "tuner") in self._cut:
            return
        if self.rng.random() < self.plan.loss:
            return

        def see(tuner: TunerProcess) -> None:
            tuner.see([(topic, self._codecs[topic].decode(raw)) for topic, raw in samples])

        self._at(self._later(), lambda: self._tuner(see))

    def present(self, name: str) -> bool:
        """Whether the tuner finds the process on the network."""
        return name in self._processes or self.time - self._gone.get(name, -LEASE) < LEASE

    def _tuner(self, act: Callable[[TunerProcess], None]) -> None:
        tuner = self._processes.get("tuner")
        if isinstance(tuner, TunerProcess):
            self._refusing(lambda: act(tuner))

    def _refusing(self, act: Callable[[], None]) -> None:
        try:
            act()
        except FrameError as error:
            self.refused.append(str(error))

    def _later(self) -> float:
        return self.time + float(self.rng.exponential(self.plan.delay))

    def _carry(self, writer: str, reader: str, topic: Topic, raw: bytes) -> None:
        """A reliable message waits for the line, and an old one gives way to a newer one."""

        def arrive() -> None:
            if (writer, reader) in self._cut:
                if topic.latched:
                    self._at(self.time + 0.1, arrive)
                return
            readers = [self._processes.get(reader), *self._strangers]
            for process in readers:
                if process is not None and process.alive and process.name == reader:
                    frame = self._codecs[topic].decode(bytes(raw))
                    self._refusing(lambda p=process, f=frame: p.take(topic, f))

        self._at(self._later(), arrive)

    def _start(self, name: str) -> None:
        rate = self._rates[name]
        made: Process
        if name == "plant":
            made = PlantProcess(self, rate)
        elif name == "controller":
            made = ControllerProcess(self, rate)
        else:
            made = TunerProcess(self, rate)
        self._processes[name] = made
        self._gone.pop(name, None)
        for (writer, topic), raw in self._latched.items():  # of those that are there
            if name in READERS[topic] and writer in self._processes and writer != name:
                self._carry(writer, name, topic, raw)

    def _crash(self, name: str, downtime: float) -> None:
        if name not in self._processes:
            return
        self._processes.pop(name).alive = False
        self._gone[name] = self.time
        self._latched = {key: raw for key, raw in self._latched.items() if key[0] != name}
        self._at(self.time + downtime, lambda: self._start(name))

    def _happen(self, fault: Fault) -> None:
        end = self.time + fault.duration
        plant, tuner = self._processes.get("plant"), self._processes.get("tuner")
        if fault.kind == "crash":
            self._crash(fault.who, fault.duration)
        elif fault.kind == "cut":
            writer, reader = fault.who.split(">")
            self._cut.add((writer, reader))
            self._at(end, lambda: self._cut.discard((writer, reader)))
        elif fault.kind == "pause plant" and isinstance(plant, PlantProcess):
            plant.pause(True)
            self._at(end, self._resume_plant)
        elif fault.kind == "hold tuner" and isinstance(tuner, TunerProcess):
            tuner.hold(True)
            self._at(end, lambda: self._tuner(lambda t: t.hold(False)))
        elif fault.kind == "second controller":
            if fault.who == "signs":  # with another limit of the actions
                rival: Process = ControllerProcess(self, 1.0, "rival", action_limit=0.1)
            else:
                rival = Stranger(self, "controller", 1.0, "rival")
            self._strangers.append(rival)
            for (_, topic), raw in self._latched.items():
                if "controller" in READERS[topic]:
                    frame = self._codecs[topic].decode(bytes(raw))
                    self._refusing(lambda t=topic, f=frame: rival.take(t, f))
            self._at(end, lambda: setattr(rival, "alive", False))
        elif fault.kind == "second tuner":
            second = SecondTuner(self, "tuner", 1.0, "rival tuner")
            self._at(self.time, second.tick)

    def _resume_plant(self) -> None:
        """The operator lets the plant go on, as soon as there is one."""
        plant = self._processes.get("plant")
        if isinstance(plant, PlantProcess):
            plant.pause(False)
            if not self.disk["pause"] and not plant.lockstep.paused:
                return
        self._at(self.time + 1.0, self._resume_plant)

    def _repeat(self, name: str, period: float) -> None:
        def again() -> None:
            if name in self._processes:
                self._processes[name].tick()
            self._at(self.time + period, again)

        self._at(self.time + period, again)

    def _at(self, time: float, event: Callable[[], None]) -> None:
        heapq.heappush(self._events, (time, next(self._numbers), event))
