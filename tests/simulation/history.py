# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One training over a simulated network, from its plan."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from pdeloop.messages.topics import ACTION, START
from tests.simulation.agenda import Agenda
from tests.simulation.disk import Disk
from tests.simulation.network import Network
from tests.simulation.plan import AIMED, MAIN, Fault, Plan
from tests.simulation.processes import (
    RUN,
    ControllerProcess,
    PlantProcess,
    Process,
    Stranger,
    TunerProcess,
    UnsignedController,
    values,
)
from tuner_node.batch import DispatchError
from tuner_node.training import Training

LEASE = 4.0
"""Seconds after which a process that has gone is missed."""
LIMIT = 3600.0
"""Virtual seconds in which every training ends."""


class History:
    """What happens. `run` gives the finished training, or the error with which the tuner ended."""

    def __init__(self, plan: Plan) -> None:
        self.plan, self.values = plan, values(plan.iterations, plan.own_plant, plan.law)
        self.rng = random.Random(plan.seed + 1)
        self.rows: list[Any] = []
        self.refused: list[str] = []
        self.records: dict[str, tuple[bool, int]] = {}
        """Each plant's record of a pause and of the run whose controller signs, which outlives it."""
        self._disk = Disk(random.Random(plan.seed + 2))
        self._agenda = Agenda(self.rng, plan.delay)
        self._gone: dict[str, float] = {}
        self._rates = dict(zip(MAIN, plan.rates, strict=True))
        self._processes: dict[str, Process] = {}
        self.network = Network(
            plan,
            self.rng,
            self._agenda,
            self._processes,
            self._handing,
            self.refused,
            self.values["action_limit"],
        )
        for name in plan.names:
            self._agenda.at(0.0, lambda name=name: self._start(name))
        for fault in plan.faults:
            self._agenda.at(fault.time, lambda fault=fault: self._happen(fault))

    @property
    def time(self) -> float:
        """Virtual seconds since the beginning."""
        return self._agenda.time

    def run(self) -> Training | DispatchError:
        """TimeoutError if the training does not end in `LIMIT` virtual seconds."""
        while self._agenda and self.time < LIMIT:
            event = self._agenda.next()
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
    def overlooked(self) -> bool:
        """True if the plant was handed what contradicts an episode, and nothing has followed.

        The tuner is given the time in which the plant's void cost comes to it. It ends with an error,
        or starts an episode again of which it still waited for something.
        """
        waited = [self.time - when for when, _ in self.network.contradicted]
        again = any(row["event"] == "repeated" for row in self.rows)
        return max(waited, default=0.0) > 20 * self.plan.delay and not again

    def missing(self, pair: int) -> list[str]:
        """Which nodes of a pair the tuner does not find on the network."""
        names = {role: f"{role} {pair}" if pair else role for role in MAIN[:2]}
        return [
            role
            for role, name in names.items()
            if name not in self._processes and self.time - self._gone.get(name, -LEASE) >= LEASE
        ]

    def _handing(self, process: Process, hand: Callable[[], None]) -> None:
        """Let a process handle something, once it does not stand still."""
        if not process.alive:
            return
        if self.time < process.stalled:
            self._agenda.at(process.stalled, lambda: self._handing(process, hand))
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
            how: dict[str, Any] = {"incarnation": self.network.tuners, "power": power, "rot": rot}
            self.network.tuners += 1
            self._join(TunerProcess(self, name, self._disk, rate, **how))

    def _join(self, process: Process) -> None:
        self._processes[process.name] = process
        self._gone.pop(process.name, None)
        process.begin()
        self.network.join(process)
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
            self._agenda.at(again, lambda: self._tick(process))

    def _end(self, name: str, downtime: float | None = None, **how: bool) -> None:
        """A process ends, and is started again after `downtime`."""
        if name not in self._processes:
            return
        self._processes.pop(name).alive = False
        self._gone[name] = self.time
        self.network.leave(name)
        if downtime is not None:
            self._agenda.at(self.time + downtime, lambda: self._start(name, **how))

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
            self.network.cut(writer, reader, end)
        elif kind == "stall":
            if who in self._processes:
                process = self._processes[who]
                process.stalled = max(process.stalled, end)
        elif kind in ("pause plant", "step plant"):
            self._call(who, "pause")
            if kind == "step plant":
                for _ in range(3):
                    self._agenda.at(
                        self.time + duration * self.rng.random(), lambda: self._call(who, "step")
                    )
            self._agenda.at(end, lambda: self._call(who, "resume", until_done=True))
        elif kind == "pause tuner":
            self._call("tuner", "pause")
            self._agenda.at(end, lambda: self._call("tuner", "resume", until_done=True))
        elif kind == "stop tuner":
            self._call("tuner", "stop")
        elif kind == "early cost":
            self.network.forge_cost()
        elif kind == "episode ahead":
            self._call("tuner", "pause")
            self._agenda.at(self.time + duration * self.rng.random(), self.network.forge_episode)
            self._agenda.at(end, lambda: self._call("tuner", "resume", until_done=True))
        elif kind == "replay":
            self.network.replay()
        elif kind == "forgery":
            self.network.forge(who, end)
        elif kind in ("late action", "late start"):
            self.network.contradict(ACTION if kind == "late action" else START)
        elif kind in AIMED:
            self.network.send_beside(kind, who, end)
        elif kind == "second controller":
            if who == "signs":  # with another limit of the actions
                rival: Process = ControllerProcess(self, "rival", action_limit=0.1)
            else:
                rival = Stranger(self, "unsigned rival", "controller")
            self._join(rival)
            self._agenda.at(end, lambda: self._end(rival.name))
        elif kind == "second tuner":
            disk = Disk(random.Random(self.plan.seed + 3))
            self._join(TunerProcess(self, "rival tuner", disk, run=RUN + 1))
            self._agenda.at(end, lambda: self._end("rival tuner"))

    def _call(self, name: str, how: str, until_done: bool = False) -> None:
        """An operator's call of a service."""
        process = self._processes.get(name)
        if isinstance(process, PlantProcess | TunerProcess):
            self._handing(process, lambda: process.operate(how))
            if self.time >= process.stalled:
                return
        if until_done:
            self._agenda.at(self.time + 1.0, lambda: self._call(name, how, until_done))
