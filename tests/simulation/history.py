# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One training over a simulated network, from its plan."""

from __future__ import annotations

import heapq
import itertools
import random
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from loop_interfaces.episodes import EPISODES_PER_START
from loop_interfaces.frames import Frame
from loop_interfaces.protocol import ModelFailure, Publication
from loop_interfaces.signature import digest_of
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
    VOID,
    CostColumn,
    StartColumn,
    Topic,
)
from tests.simulation.disk import Disk
from tests.simulation.plan import MAIN, STALE, Fault, Plan
from tests.simulation.processes import (
    EVERY_PAIR,
    RUN,
    ControllerProcess,
    PlantProcess,
    Process,
    Stranger,
    TunerProcess,
    UnsignedController,
    values,
)
from tuner_node.errors import DispatchError
from tuner_node.training import Training

LEASE = 4.0
"""Seconds after which a process that has gone is missed."""
LIMIT = 3600.0
"""Virtual seconds in which every training ends."""
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
RECALLED = 200
"""Messages that can be replayed."""


class History:
    """What happens. `run` gives the finished training, or the error with which the tuner ended."""

    def __init__(self, plan: Plan) -> None:
        self.plan, self.values = plan, values(plan.iterations, plan.own_plant, plan.law)
        self.rng = random.Random(plan.seed + 1)
        self.time = 0.0
        self.rows: list[Any] = []
        self.refused: list[str] = []
        self.records: dict[str, tuple[bool, int]] = {}
        """Each plant's record of a pause and of the run whose controller signs, which outlives it."""
        self._disk = Disk(random.Random(plan.seed + 2))
        self._starts = 0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._codecs = {topic: topic.codec() for topic in READERS}
        self._latched: dict[tuple[str, int, Topic], bytes] = {}
        self._sent: deque[tuple[Topic, bytes, int]] = deque(maxlen=RECALLED)
        self._forged: dict[str, float] = {}
        """Topics on which messages are forged, and until when."""
        self._forgeries: set[tuple[Any, ...]] = set()
        self._heard: set[tuple[Any, ...]] = set()
        """Readers and headers of the forged messages that came, and of the others. An answer to a
        forged state counts as forged: the plant can only tell by the answer to its own. So does one
        of a controller that does not sign, to a plant that no other has answered yet."""
        self._answered: set[Process] = set()
        """Plants that the loop's own controller has answered."""
        self._taken_back: set[tuple[int, int]] = set()
        """Pairs and episodes whose cost is void, which the tuner that began them has not heard."""
        self._early: list[int] = []
        """Episodes of the first pair of which a cost was forged before their end."""
        self._begun = 0
        """The last episode that its tuner began there."""
        self.contradicted: list[tuple[float, int]] = []
        """When the plant was handed what contradicts an episode whose cost the tuner has, and which."""
        self._beside: dict[tuple[str, str], float] = {}
        """Kinds of stale messages and the topics beside whose messages they come, and until when."""
        self._past: dict[tuple[Topic, int], deque[Frame]] = {}
        """What was sent before, by topic and pair."""
        self._costs: list[int] = []
        """Episodes of the first pair whose completed costs the tuner has heard."""
        self._answers_forged = False
        """True if what a controller sends now answers a forged state."""
        self._cut: set[tuple[str, str]] = set()
        self._gone: dict[str, float] = {}
        self._rates = dict(zip(MAIN, plan.rates, strict=True))
        self._processes: dict[str, Process] = {}
        for name in plan.names:
            self._at(0.0, lambda name=name: self._start(name))
        for fault in plan.faults:
            self._at(fault.time, lambda fault=fault: self._happen(fault))

    def run(self) -> Training | DispatchError:
        """TimeoutError if the training does not end in `LIMIT` virtual seconds."""
        while self._events and self.time < LIMIT:
            self.time, _, event = heapq.heappop(self._events)
            try:
                event()
            except DispatchError as error:
                return error
            tuner = self._processes.get("tuner")
            if isinstance(tuner, TunerProcess):
                if tuner.session.done:
                    return tuner.session.training
                if tuner.session.stopped:
                    self._end("tuner", self.rng.expovariate(1.0))
        raise TimeoutError(f"no end within {LIMIT:g} virtual seconds")

    @property
    def unopposed(self) -> bool:
        """True if a forged message, or the answer to a forged state, came to a process that the
        true one with its header never reached, or contradicted too late for the run.

        A cost in the middle of an episode plant and controller contradict together, once the tuner has
        begun a later one, if both are there all the time and heard.
        """
        early = [number for number in self._early if self.plan.hides or number == self._begun]
        return bool(self._taken_back or early) or not self._forgeries <= self._heard

    @property
    def overlooked(self) -> bool:
        """True if the plant was handed what contradicts an episode, and nothing has followed.

        The tuner is given the time in which the plant's void cost comes to it. It ends with an error,
        or starts an episode again of which it still waited for something.
        """
        waited = [self.time - when for when, _ in self.contradicted]
        again = any(row["event"] == "repeated" for row in self.rows)
        return max(waited, default=0.0) > 20 * self.plan.delay and not again

    def send(self, writer: Process, sent: Publication | ModelFailure, pair: int) -> None:
        """Bring a message to who reads its topic in the namespace of a pair, as the network at that
        moment does.
        """
        if isinstance(sent, ModelFailure):
            text = sent.to_json()
            self._later(lambda: self._tell(writer, ModelFailure.from_json(text)))
            return
        topic, plan = sent.topic, self.plan
        raw = self._codecs[topic].encode(sent.frame)
        if topic.latched:
            self._latched[writer.name, pair, topic] = raw
        if topic is START and writer.name == "tuner" and not pair:
            self._begun = max(self._begun, sent.frame.episode)
        if topic is COST and _is_void(sent.frame):
            self._taken_back.add((pair, sent.frame.episode))
        self._sent.append((topic, raw, pair))
        if self.time < self._forged.get(topic.name, 0.0):
            forgery = self._codecs[topic].encode(self._forgery(sent.frame))
            for process in self._reading(topic, pair):
                self._carry("stranger", process, topic, forgery, pair)
        self._send_beside(topic, sent.frame, pair)
        for process in self._reading(topic, pair):
            copies = 1
            if not topic.latched:  # the others are reliable
                copies = (self.rng.random() >= plan.loss) + (self.rng.random() < plan.duplicates)
            for _ in range(copies):
                self._carry(writer.name, process, topic, self._damaged(raw, sent.frame), pair)

    def _send_beside(self, topic: Topic, frame: Frame, pair: int) -> None:
        """Bring what comes beside a message because it is stale, or meant for others."""
        past = self._past.setdefault((topic, pair), deque(maxlen=RECALLED))
        samples = topic in (STATE, ACTION)
        earlier = [
            known
            for known in past
            if (known.episode, known.step) != (frame.episode, frame.step)
            and known.episode <= frame.episode
            and (known.step == frame.step or not samples)
        ]
        past.append(replace(frame, values=frame.values.copy()))
        for kind in ("stale", "another run", "another plant"):
            if self.time >= self._beside.get((kind, topic.name), 0.0):
                continue
            if kind == "stale":
                others = [self.rng.choice(earlier)] if earlier else []
            else:
                ids = {"run": RUN + 1} if kind == "another run" else {"plant": frame.plant + 1}
                others = [replace(self._forgery(frame), **ids)]
            for other in others:
                raw = self._codecs[topic].encode(other)
                for process in self._reading(topic, pair):
                    self._carry("", process, topic, raw, pair)

    def _contradict(self, topic: Topic) -> None:
        """Hand the plant another action or start of the last episode whose cost the tuner has."""
        plant = self._processes.get("plant")
        last = self._costs[-1] if self._costs else 0
        if not isinstance(plant, PlantProcess):
            return
        horizon = plant.lockstep.plant.horizon  # the last action only says that the state has come
        sent = self._past.get((topic, 0), ())
        known = [f for f in sent if f.episode == last and (topic is START or f.step < horizon)]
        if not known:
            return
        frame = self._forgery(self.rng.choice(known))

        def arrive() -> None:
            refused = len(self.refused)
            self._handing(plant, partial(plant.take, topic, frame, 0))
            if len(self.refused) == refused:
                self.contradicted.append((self.time, last))

        self._later(arrive)

    def show(self, plant: Process, samples: list[tuple[Topic, Frame]]) -> None:
        """Bring the samples of an episode to the tuners, if they read them."""
        if self.plan.iterations or not samples or self.rng.random() < self.plan.loss:
            return
        shown = [(samples, self._heard)]
        if self.time < self._forged.get("samples", 0.0):
            forgery = [(topic, self._forgery(frame)) for topic, frame in samples]
            shown.append((forgery, self._forgeries))

        def see(
            tuner: TunerProcess, batch: list[tuple[Topic, Frame]], came: set[tuple[Any, ...]]
        ) -> None:
            came.add((tuner, "samples", plant.pair, batch[0][1].episode))
            tuner.see(batch, plant.pair)

        for tuner in self._processes.values():
            if isinstance(tuner, TunerProcess) and (plant.name, tuner.name) not in self._cut:
                for batch, came in shown:
                    self._later(partial(self._handing, tuner, partial(see, tuner, batch, came)))

    def missing(self, pair: int) -> list[str]:
        """Which nodes of a pair the tuner does not find on the network."""
        names = {role: f"{role} {pair}" if pair else role for role in MAIN[:2]}
        return [
            role
            for role, name in names.items()
            if name not in self._processes and self.time - self._gone.get(name, -LEASE) >= LEASE
        ]

    def _tell(self, writer: Process, failure: ModelFailure) -> None:
        for tuner in list(self._processes.values()):
            if isinstance(tuner, TunerProcess) and (writer.name, tuner.name) not in self._cut:
                self._handing(tuner, lambda tuner=tuner: tuner.fail(failure, writer.pair))

    def _reading(self, topic: Topic, pair: int) -> list[Process]:
        return [
            process for process in self._processes.values() if self._reads(process, topic, pair)
        ]

    @staticmethod
    def _reads(process: Process, topic: Topic, pair: int) -> bool:
        return process.role in READERS[topic] and process.pair in (pair, EVERY_PAIR)

    def _forgery(self, frame: Frame) -> Frame:
        """The same header with other values."""
        values = frame.values.copy()
        if values.size:
            values.flat[self.rng.randrange(values.size)] += 1.0
        return replace(frame, values=values)

    def _damaged(self, raw: bytes, frame: Frame) -> bytes:
        """The message, or with a changed bit in what is in front of its values."""
        if self.rng.random() >= self.plan.damage:
            return raw
        changed = bytearray(raw)
        changed[self.rng.randrange(len(raw) - frame.values.nbytes)] ^= 1 << self.rng.randrange(8)
        return bytes(changed)

    def _carry(self, writer: str, process: Process, topic: Topic, raw: bytes, pair: int) -> None:
        """Bring a message to a process; where the line is cut, a reliable one waits for it."""
        answers_forged = topic is ACTION and self._answers_forged

        def arrive() -> None:
            if (writer, process.name) in self._cut:
                if topic.latched and process.alive:
                    self._at(self.time + 0.1, arrive)
                return
            self._handing(process, take)

        def take() -> None:
            frame = self._codecs[topic].decode(bytes(raw))
            if topic is ACTION and writer.startswith("controller"):
                self._answered.add(process)
            unsigned = writer == "unsigned rival" and process not in self._answered
            forged = writer == "stranger" or answers_forged or unsigned
            header = topic, pair, frame.run, frame.episode, frame.step, frame.time, frame.plant
            # What comes when the tuner that began the episode has ended is too late for its run.
            start = frame.episode // EPISODES_PER_START
            if not frame.episode or ("tuner" in self._processes and start == self._starts - 1):
                (self._forgeries if forged else self._heard).add((process, *header))
                if topic is COST and process.name == "tuner" and _is_void(frame):
                    self._taken_back.discard((pair, frame.episode))
            if topic is COST and process.name == "tuner" and not (pair or _is_void(frame)):
                self._costs.append(frame.episode)
            self._answers_forged = forged and topic is STATE
            try:
                process.take(topic, frame, pair)
            finally:
                self._answers_forged = False

        self._later(arrive)

    def _handing(self, process: Process, hand: Callable[[], None]) -> None:
        """Let a process handle something, once it does not stand still."""
        if not process.alive:
            return
        if self.time < process.stalled:
            self._at(process.stalled, lambda: self._handing(process, hand))
            return
        try:
            hand()
        except ValueError as error:
            self.refused.append(str(error))
        except DispatchError as error:
            if process.name == "tuner":
                raise
            self._end(process.name)
            self.refused.append(str(error))

    def _start(self, name: str, *, power: bool = False, rot: bool = False) -> None:
        role, _, number = name.partition(" ")
        rate, pair = self._rates[role], int(number or 0)
        if role == "plant":
            self._join(PlantProcess(self, name, rate, pair))
        elif role == "controller":
            make = ControllerProcess if self.plan.signs else UnsignedController
            self._join(make(self, name, rate, pair))
        else:
            how: dict[str, Any] = {"incarnation": self._starts, "power": power, "rot": rot}
            self._starts += 1
            self._join(TunerProcess(self, name, self._disk, rate, **how))

    def _join(self, process: Process) -> None:
        self._processes[process.name] = process
        self._gone.pop(process.name, None)
        process.begin()
        for (writer, pair, topic), raw in self._latched.items():
            if self._reads(process, topic, pair) and writer != process.name:
                self._carry(writer, process, topic, raw, pair)
        self._tick(process)

    def _tick(self, process: Process) -> None:
        again = self.time
        if self.time < process.stalled:
            again = process.stalled
        else:
            later: list[float] = []
            self._handing(process, lambda: later.append(process.tick()))
            again += later[0] if later else LIMIT
        if process.alive and again < LIMIT:
            self._at(again, lambda: self._tick(process))

    def _end(self, name: str, downtime: float | None = None, **how: bool) -> None:
        """A process ends, and is started again after `downtime`."""
        if name not in self._processes:
            return
        self._processes.pop(name).alive = False
        self._gone[name] = self.time
        self._latched = {key: raw for key, raw in self._latched.items() if key[0] != name}
        if downtime is not None:
            self._at(self.time + downtime, lambda: self._start(name, **how))

    def _happen(self, fault: Fault) -> None:
        kind, who, duration, end = fault.kind, fault.who, fault.duration, self.time + fault.duration
        if kind == "crash":
            self._end(who, duration)
        elif kind in ("power cut", "bit rot"):
            for name in self.plan.names:
                tuner = name == "tuner"
                how = {"power": True, "rot": kind == "bit rot"} if tuner else {}
                self._end(name, duration * self.rng.random(), **how)
        elif kind == "cut":
            writer, reader = who.split(">")
            self._cut.add((writer, reader))
            self._at(end, lambda: self._cut.discard((writer, reader)))
        elif kind == "stall":
            if who in self._processes:
                process = self._processes[who]
                process.stalled = max(process.stalled, end)
        elif kind in ("pause plant", "step plant"):
            self._call(who, "pause")
            if kind == "step plant":
                for _ in range(3):
                    self._at(
                        self.time + duration * self.rng.random(),
                        lambda: self._call(who, "step"),
                    )
            self._at(end, lambda: self._call(who, "resume", until_done=True))
        elif kind == "pause tuner":
            self._call("tuner", "pause")
            self._at(end, lambda: self._call("tuner", "resume", until_done=True))
        elif kind == "stop tuner":
            self._call("tuner", "stop")
        elif kind == "early cost":
            self._forge_cost()
        elif kind == "episode ahead":
            self._call("tuner", "pause")
            self._at(self.time + duration * self.rng.random(), self._forge_episode)
            self._at(end, lambda: self._call("tuner", "resume", until_done=True))
        elif kind == "replay" and self._sent:
            topic, raw, pair = self.rng.choice(self._sent)
            for process in self._reading(topic, pair):
                self._carry("", process, topic, raw, pair)
        elif kind == "forgery":
            self._forged[who] = end
        elif kind in ("late action", "late start"):
            self._contradict(ACTION if kind == "late action" else START)
        elif kind in STALE:
            self._beside[kind, who] = end
        elif kind == "second controller":
            if who == "signs":  # with another limit of the actions
                rival: Process = ControllerProcess(self, "rival", action_limit=0.1)
            else:
                rival = Stranger(self, "unsigned rival", "controller")
            self._join(rival)
            self._at(end, lambda: self._end(rival.name))
        elif kind == "second tuner":
            disk = Disk(random.Random(self.plan.seed + 3))
            self._join(TunerProcess(self, "rival tuner", disk, run=RUN + 1))
            self._at(end, lambda: self._end("rival tuner"))

    def _forge_cost(self) -> None:
        """Say in the middle of an episode that it is completed, to all readers at the same time."""
        plant = self._processes.get("plant")
        if not isinstance(plant, PlantProcess):
            return
        lockstep, horizon = plant.lockstep, plant.lockstep.plant.horizon
        state = lockstep.last_state
        if state is None or not 0 < lockstep.step < horizon:
            return
        rows = lockstep.plant.episode_costs().rows()
        raw = self._codecs[COST].encode(replace(state, step=horizon, values=rows))
        self._early.append(state.episode)

        def arrive() -> None:
            for process in self._reading(COST, 0):
                frame = self._codecs[COST].decode(raw)
                self._handing(process, partial(process.take, COST, frame, 0))

        self._later(arrive)

    def _forge_episode(self) -> None:
        """Begin the episode after the tuner's last one, with other rows, another policy and its D."""
        latched = {
            topic: self._codecs[topic].decode(raw)
            for (writer, pair, topic), raw in self._latched.items()
            if (writer, pair) == ("tuner", 0)
        }
        start = latched.get(START)
        if start is None or not len(start.values):
            return
        rows, sent = start.values.copy(), []
        rows[:, StartColumn.SEED] += 1
        signed: list[Any] = [rows, self.values["action_limit"]]
        if POLICY in latched and rows[0, StartColumn.EXCITATION] < 0:
            values = 1.5 * latched[POLICY].values
            signed += [values, digest_of(latched[MODEL].values)]
            sent.append(
                (POLICY, replace(latched[POLICY], episode=start.episode + 1, values=values))
            )
        forged = replace(start, episode=start.episode + 1, values=rows, plant=digest_of(*signed))
        for topic, frame in (*sent, (START, forged)):
            for process in self._reading(topic, 0):
                self._carry("", process, topic, self._codecs[topic].encode(frame), 0)

    def _call(self, name: str, how: str, until_done: bool = False) -> None:
        """An operator's call of a service."""
        process = self._processes.get(name)
        if isinstance(process, PlantProcess | TunerProcess):
            self._handing(process, lambda: process.operate(how))
            if self.time >= process.stalled:
                return
        if until_done:
            self._at(self.time + 1.0, lambda: self._call(name, how, until_done))

    def _later(self, event: Callable[[], None]) -> None:
        self._at(self.time + self.rng.expovariate(1.0 / self.plan.delay), event)

    def _at(self, time: float, event: Callable[[], None]) -> None:
        heapq.heappush(self._events, (time, next(self._numbers), event))


def _is_void(cost: Frame) -> bool:
    return bool((cost.values[:, CostColumn.ENDED] == VOID).any())
