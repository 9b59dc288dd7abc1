# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One training carried out by plant and controller pairs: Training and Dispatcher joined. Pure.

Events of the pairs go to the dispatcher; `advance` takes what it answers, finishes a batch whose
results are all there, and assigns the next one. Events are given to `report` as JSON-able rows.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pdeloop.messages.diagnostics import ConditionTimer
from tuner_node.batch import DispatchError
from tuner_node.dispatch import Dispatcher
from tuner_node.pair import PairPublication
from tuner_node.training import Training

Report = Callable[[Mapping[str, Any]], None]


class Session:
    """Drives a training to its end over a dispatcher."""

    def __init__(self, training: Training, dispatcher: Dispatcher, report: Report) -> None:
        self.training = training
        self.dispatcher = dispatcher
        self._report = report
        self._phase = ""
        self.done = False
        self.established = False
        """True once a pair has served this session: any other tuner then came later."""
        self.stopping = False
        """True once an operator asked for the end after the rollouts under way."""
        self.stopped = False
        """True once that end has come; the training's state is that of a checkpoint."""
        self._checked: dict[int, Mapping[str, Any]] = {}
        self._generation = 0

    def begin(self, now: float) -> list[PairPublication]:
        """The first messages; after a resume with the models that are already there.

        Called again when the network was joined again: what is under way is asked for once more.
        """
        if self._phase:
            return self.dispatcher.resend(now)
        return self._new_models() + self._next(now)

    def baseline(self, name: str) -> float | None:
        """Mean cost of the controller `none` or `lqt` when the warm starts were checked, if known."""
        costs = [float(row[name]) for row in self._checked.values()]
        return sum(costs) / len(costs) if costs else None

    def stop(self) -> list[PairPublication]:
        """End when the rollouts under way are over; at once in a pause, when none is running.

        The results of an unfinished batch are dropped, and computed again, identically, when the run is
        continued.
        """
        self.stopping = True
        return self._end() if self.dispatcher.paused else []

    def advance(self, publications: list[PairPublication], now: float) -> list[PairPublication]:
        """The messages to send after an event, which the dispatcher has answered with `publications`.

        now: monotonic time in s. Raises DispatchError if the training cannot use a batch's result.
        """
        for note in self.dispatcher.notes:
            self._report({"event": "repeated", "reason": note})
        self.dispatcher.notes.clear()
        result = self.dispatcher.result()
        if result is None:
            return publications
        self.established = True
        training = self.training
        for row in training.batch_costs(result):
            self._report(row)
        try:
            rows = training.finish(result)
        except DispatchError:
            raise
        except ValueError as error:  # a result that the training cannot use: no use in waiting
            raise DispatchError(str(error)) from error
        for row in rows:
            if row["event"] == "checked":
                self._checked[row["seed"]] = row
            self._report(row)
        publications = publications + self._new_models()
        if self.stopping and training.phase != "done":
            return publications + self._end()
        return publications + self._next(now)

    def _new_models(self) -> list[PairPublication]:
        """The models, if they are others than before."""
        training = self.training
        if not training.ready or self._generation == training.generation:
            return []
        assert training.models is not None
        self._generation = training.generation
        return self.dispatcher.models(training.models, training.generation)

    def _end(self) -> list[PairPublication]:
        self.stopped = True
        return self.dispatcher.release()

    def _next(self, now: float) -> list[PairPublication]:
        batch = self.training.next_batch()
        if self.training.phase != self._phase:
            self._phase = self.training.phase
            self._report({"event": "phase", "phase": self._phase, **self.training.progress})
        if batch is None:
            self.done = True
            return []
        return self.dispatcher.assign(batch, now)


SECOND_TUNER_GRACE = 6.0
"""Seconds a second tuner may be seen before it counts as one: a killed one is seen for 4 s."""


@dataclass(frozen=True)
class Publishers:
    """Numbers of publishers of the topics that show the participants.

    plants, controllers: of `episode/cost` and `model/identified`, by pair; tuners: of each
    `episode/start`, this tuner's own among them; recorders: of `recorder/status`; unmatched: those of
    them that do not yet read every `episode/start` of this tuner, as long as one is awaited.
    """

    plants: Sequence[int]
    controllers: Sequence[int]
    tuners: Mapping[str, int]
    recorders: int
    unmatched: int = 0


class Participants:
    """Reports to a session's dispatcher who is missing, and refuses who should not be there.

    recorder: the tuner's parameter of this name.
    """

    def __init__(self, session: Session, recorder: str) -> None:
        self._session, self._recorder = session, recorder
        self._recorder_seen = False
        self._second_tuner = ConditionTimer()
        self._paused: list[int] = []

    @property
    def awaits_recorder(self) -> bool:
        """True until a recorder was there from which no start of an episode can be lost."""
        return self._recorder != "none" and not self._recorder_seen

    def update(self, there: Publishers, now: float) -> list[PairPublication]:
        """The messages to send now that these publishers are present (now: monotonic s).

        DispatchError where a required recorder has gone, or another tuner publishes.
        """
        self._refuse_second_tuner(there.tuners, now)
        self._look_for_recorder(there)
        absent = ["recorder"] if self.awaits_recorder else []
        publications = []
        for pair, counts in enumerate(zip(there.plants, there.controllers, strict=True)):
            roles = zip(("plant", "controller"), counts, strict=True)
            missing = [role for role, count in roles if not count] + absent
            publications += self._session.dispatcher.presence(pair, missing, now)
        return publications + self._session.dispatcher.tick(now)

    def newly_paused(self, now: float) -> str:
        """Plants that were paused or resumed since the last call, in words; may be empty."""
        dispatcher = self._session.dispatcher
        paused, before = dispatcher.paused_pairs(now), self._paused
        if paused == before:
            return ""
        self._paused = paused
        if not paused:
            return "no plant is paused"
        which = f" of pair {', '.join(map(str, paused))}" if len(dispatcher.pairs) > 1 else ""
        return f"the plant{which} is paused"

    def _look_for_recorder(self, there: Publishers) -> None:
        """Note a recorder that misses nothing; DispatchError where a required one has gone.

        One may be discovered before its subscriptions are.
        """
        if self._recorder == "required" and self._recorder_seen and not there.recorders:
            raise DispatchError(
                "the recorder has gone, but this training has to be recorded; continue it from "
                "its folder with resume:=true"
            )
        self._recorder_seen |= there.recorders > there.unmatched

    def _refuse_second_tuner(self, tuners: Mapping[str, int], now: float) -> None:
        """DispatchError if another tuner publishes, unless a pair serves this one and refuses it."""
        shared = [topic for topic, count in tuners.items() if count > 1]
        unserved = bool(shared) and not self._session.established
        if self._second_tuner.seconds(unserved, now) > SECOND_TUNER_GRACE:
            raise DispatchError(
                f"another tuner publishes {shared[0]}; "
                "stop it, or start this one in another namespace or ROS domain"
            )
