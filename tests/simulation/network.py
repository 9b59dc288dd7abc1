# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The network of a simulated training: it loses, repeats, damages and delays, and strangers forge."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from pdeloop.messages.frames import Frame
from pdeloop.messages.protocol import ModelFailure, Publication, digest_of
from pdeloop.messages.topics import (
    ACTION,
    COST,
    EPISODES_PER_START,
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
from tests.simulation.agenda import Agenda
from tests.simulation.plan import Plan
from tests.simulation.processes import EVERY_PAIR, RUN, PlantProcess, Process, TunerProcess

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
Hand = Callable[[Process, Callable[[], None]], None]
"""Lets a process handle something, once it does not stand still."""


class Network:
    """What becomes of each message, and those that nobody of the loop has sent.

    processes: those that there are, by name; hand: how one of them is given something; refused: what
    they say of messages that they do not take; action_limit: that of the training.
    """

    def __init__(
        self,
        plan: Plan,
        rng: random.Random,
        agenda: Agenda,
        processes: dict[str, Process],
        hand: Hand,
        refused: list[str],
        action_limit: float,
    ) -> None:
        self._plan, self._rng, self._agenda = plan, rng, agenda
        self._processes, self._hand, self._refused = processes, hand, refused
        self._action_limit = action_limit
        self.tuners = 0
        """How often a tuner of the training was started."""
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

    @property
    def unopposed(self) -> bool:
        """True if a forged message, or the answer to a forged state, came to a process that the
        true one with its header never reached, or contradicted too late for the run.

        A cost in the middle of an episode plant and controller contradict together, once the tuner has
        begun a later one, if both are there all the time and heard.
        """
        early = [number for number in self._early if self._plan.hides or number == self._begun]
        return bool(self._taken_back or early) or not self._forgeries <= self._heard

    def send(self, writer: Process, sent: Publication | ModelFailure, pair: int) -> None:
        """Bring a message to who reads its topic in the namespace of a pair, as the network at that
        moment does.
        """
        if isinstance(sent, ModelFailure):
            text = sent.to_json()
            self._agenda.later(lambda: self._tell(writer, ModelFailure.from_json(text)))
            return
        topic, plan = sent.topic, self._plan
        raw = self._codecs[topic].encode(sent.frame)
        if topic.latched:
            self._latched[writer.name, pair, topic] = raw
        if topic is START and writer.name == "tuner" and not pair:
            self._begun = max(self._begun, sent.frame.episode)
        if topic is COST and _is_void(sent.frame):
            self._taken_back.add((pair, sent.frame.episode))
        self._sent.append((topic, raw, pair))
        if self._agenda.time < self._forged.get(topic.name, 0.0):
            forgery = self._codecs[topic].encode(self._forgery(sent.frame))
            for process in self._reading(topic, pair):
                self._carry("stranger", process, topic, forgery, pair)
        self._send_beside(topic, sent.frame, pair)
        for process in self._reading(topic, pair):
            copies = 1
            if not topic.latched:  # the others are reliable
                copies = (self._rng.random() >= plan.loss) + (self._rng.random() < plan.duplicates)
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
            if self._agenda.time >= self._beside.get((kind, topic.name), 0.0):
                continue
            if kind == "stale":
                others = [self._rng.choice(earlier)] if earlier else []
            else:
                ids = {"run": RUN + 1} if kind == "another run" else {"plant": frame.plant + 1}
                others = [replace(self._forgery(frame), **ids)]
            for other in others:
                raw = self._codecs[topic].encode(other)
                for process in self._reading(topic, pair):
                    self._carry("", process, topic, raw, pair)

    def show(self, plant: Process, samples: list[tuple[Topic, Frame]]) -> None:
        """Bring the samples of an episode to the tuners, if they read them."""
        if self._plan.iterations or not samples or self._rng.random() < self._plan.loss:
            return
        shown = [(samples, self._heard)]
        if self._agenda.time < self._forged.get("samples", 0.0):
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
                    self._agenda.later(partial(self._hand, tuner, partial(see, tuner, batch, came)))

    def _tell(self, writer: Process, failure: ModelFailure) -> None:
        for tuner in list(self._processes.values()):
            if isinstance(tuner, TunerProcess) and (writer.name, tuner.name) not in self._cut:
                self._hand(tuner, lambda tuner=tuner: tuner.fail(failure, writer.pair))

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
            values.flat[self._rng.randrange(values.size)] += 1.0
        return replace(frame, values=values)

    def _damaged(self, raw: bytes, frame: Frame) -> bytes:
        """The message, or with a changed bit in what is in front of its values."""
        if self._rng.random() >= self._plan.damage:
            return raw
        changed = bytearray(raw)
        changed[self._rng.randrange(len(raw) - frame.values.nbytes)] ^= 1 << self._rng.randrange(8)
        return bytes(changed)

    def _carry(self, writer: str, process: Process, topic: Topic, raw: bytes, pair: int) -> None:
        """Bring a message to a process; where the line is cut, a reliable one waits for it."""
        answers_forged = topic is ACTION and self._answers_forged

        def arrive() -> None:
            if (writer, process.name) in self._cut:
                if topic.latched and process.alive:
                    self._agenda.at(self._agenda.time + 0.1, arrive)
                return
            self._hand(process, take)

        def take() -> None:
            frame = self._codecs[topic].decode(bytes(raw))
            if topic is ACTION and writer.startswith("controller"):
                self._answered.add(process)
            unsigned = writer == "unsigned rival" and process not in self._answered
            forged = writer == "stranger" or answers_forged or unsigned
            header = topic, pair, frame.run, frame.episode, frame.step, frame.time, frame.plant
            # What comes when the tuner that began the episode has ended is too late for its run.
            start = frame.episode // EPISODES_PER_START
            if not frame.episode or ("tuner" in self._processes and start == self.tuners - 1):
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

        self._agenda.later(arrive)

    def join(self, process: Process) -> None:
        """Bring what is latched to a process that is new."""
        for (writer, pair, topic), raw in self._latched.items():
            if self._reads(process, topic, pair) and writer != process.name:
                self._carry(writer, process, topic, raw, pair)

    def leave(self, name: str) -> None:
        """What a process has latched goes with it."""
        self._latched = {key: raw for key, raw in self._latched.items() if key[0] != name}

    def cut(self, writer: str, reader: str, end: float) -> None:
        """Nothing passes from one process to another until then."""
        self._cut.add((writer, reader))
        self._agenda.at(end, lambda: self._cut.discard((writer, reader)))

    def forge(self, topic: str, end: float) -> None:
        """Until then each message on a topic comes with one of the same header and other values."""
        self._forged[topic] = end

    def send_beside(self, kind: str, topic: str, end: float) -> None:
        """Until then each message on a topic comes with one of this kind of `AIMED`."""
        self._beside[kind, topic] = end

    def replay(self) -> None:
        """Deliver a message from before again."""
        if self._sent:
            topic, raw, pair = self._rng.choice(self._sent)
            for process in self._reading(topic, pair):
                self._carry("", process, topic, raw, pair)

    def contradict(self, topic: Topic) -> None:
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
        frame = self._forgery(self._rng.choice(known))

        def arrive() -> None:
            refused = len(self._refused)
            self._hand(plant, partial(plant.take, topic, frame, 0))
            if len(self._refused) == refused:
                self.contradicted.append((self._agenda.time, last))

        self._agenda.later(arrive)

    def forge_cost(self) -> None:
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
                self._hand(process, partial(process.take, COST, frame, 0))

        self._agenda.later(arrive)

    def forge_episode(self) -> None:
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
        signed: list[Any] = [rows, self._action_limit]
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


def _is_void(cost: Frame) -> bool:
    return bool((cost.values[:, CostColumn.ENDED] == VOID).any())
