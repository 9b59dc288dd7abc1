# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One training carried out by plant and controller pairs: Training and Dispatcher joined. Pure.

Events of the pairs go to the dispatcher; `advance` takes what it answers, finishes a batch whose
results are all there, and assigns the next one. Events are given to `report` as JSON-able rows.
"""

from collections.abc import Callable, Mapping
from typing import Any

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
