# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The controller's side of the loop: answer every state. Pure: no ROS, no clock.

It answers every state of an episode whose start it has, including repeated ones, and the answer depends
only on (state, policy, model, step) or, in an exploratory episode, on (seed, step). After a restart the
latched topics restore everything it keeps, except the samples of an exploratory episode and the memory
of a law that has one, which is a function of the episode's states: if it missed some, it reports
that, and the episode is run again.
"""

from collections import Counter, OrderedDict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from controller_node.exploration import Exploration
from controller_node.identification import DesignSettings
from controller_node.law_batch import LawBatch, MemoryUnknownError
from controller_node.run_state import (
    MAX_RUNS,
    AnsweredSteps,
    Answering,
    EpisodeInputs,
    Models,
    RunState,
    contradict,
    differ,
    digest_of_start,
    forget,
)
from pdeloop.messages import model_rows
from pdeloop.messages.frames import KEPT_ARRAY, Frame, FrameError
from pdeloop.messages.protocol import NOT_SIGNED, ModelFailure, Publication, digest_of, signature
from pdeloop.messages.topics import (
    ACTION,
    COMPLETED,
    MAX_GAIN,
    CostColumn,
    StartColumn,
    episode_name,
    start_rows,
)
from pdeloop.method.laws.registry import law_kind, laws_of

MAX_BYTES = 2**29
"""Bytes that are kept of all runs together, and half as many of targets. Less recently used ones are
dropped for a newer one; a run that has no room alone is refused, and an exploratory episode without
room gives no model."""


class Responder:
    """One controller. It answers whichever run the plant serves; runs never share anything.

    Every event returns the messages to publish: above all the answer to a state, also to one that
    waited for what the event brings. A FrameError, or another ValueError, refuses a message.
    """

    def __init__(self, settings: DesignSettings) -> None:
        """ValueError if there is no law of that name, or it is code that is not allowed."""
        self._settings, self._law_kind = settings, law_kind(settings.law, settings.constants)
        self._targets: OrderedDict[int, np.ndarray] = OrderedDict()
        self._runs: OrderedDict[int, RunState] = OrderedDict()
        self._served = (-1, -1)
        """Run and plant of the last answer."""
        self._pending: Frame | None = None
        self.counters: Counter[str] = Counter()
        """Events, counted by name."""
        self.answered = 0
        self.episode = self.step = -1
        """Episode and step of the last answer."""
        self.last_cost: float | None = None
        """Mean stage cost of the last episode's environments."""
        self.failure = ""
        """Why the last episode's identification gave no model; empty if it did."""
        self._ended = (-1, -1)
        """Run and episode of the last cost."""
        self._steps = AnsweredSteps()

    @property
    def run(self) -> int | None:
        """The run that was answered last."""
        return self._served[0] if self._served[0] >= 0 else None

    @property
    def under_way(self) -> bool:
        """True while the last answered episode is under way."""
        run = self._served[0]
        return run in self._runs and (run, self.episode) != self._ended

    @property
    def exploring(self) -> bool:
        """True if the episode that was answered last explores."""
        run = self._runs.get(self._served[0])
        return run is not None and run.exploration is not None

    def target(self, frame: Frame) -> list[Publication | ModelFailure]:
        """Take the target z_r of a plant, (n_z,)."""
        targets = self._targets
        targets[frame.plant] = frame.values.copy()
        forget(
            targets,
            frame.plant,
            self._served[1],
            lambda: sum(target.nbytes for target in targets.values()) > MAX_BYTES // 2,
        )
        for run in self._runs.values():
            run.answering = None
        return self._answer_pending()

    def start(self, frame: Frame) -> Sequence[Publication | ModelFailure]:
        """Take the start of an episode: whether it explores, and which model each environment uses.

        A repeated one is answered with the result of an exploration; one of an earlier episode is
        ignored. Another one for the same episode asks for a new one, as the plant may have taken
        either. FrameError for rows that do not fit a start, and where there is no room for another
        run.
        """
        rows = start_rows(frame)
        if not len(rows):
            self._runs.pop(frame.run, None)
            return []
        run = self._run(frame.run, rows.nbytes)
        known = run.start
        if known is not None and frame.episode < known.episode:
            self.counters["starts of an earlier episode"] += 1
            return []
        if known is None or frame.episode > known.episode:
            run.start = replace(frame, values=rows.copy())
            explores = rows[0, StartColumn.EXCITATION] >= 0
            run.exploration = Exploration(run.start, self._settings) if explores else None
            self.failure = ""
        elif differ(known, frame):
            reason = f"two different starts arrived for episode {episode_name(frame.episode)}"
            return [ModelFailure(frame.run, frame.episode, True, f"{reason}; expected one tuner")]
        elif run.exploration and run.exploration.outcomes:
            return list(run.exploration.outcomes.values())  # the answer may have been lost
        return self._answer_pending()

    def policy(self, frame: Frame) -> list[Publication | ModelFailure]:
        """Take theta of an episode's environments: gains (M, n_a, 2 n_s), of another law (M, size).

        Where others came for the episode before, those are taken that its start signs. FrameError
        then, and for another number of axes or of actuators, or numbers beyond MAX_GAIN.
        """
        n_a, kind = self._settings.n_a, self._law_kind
        if frame.values.ndim != 1 + kind.axes:
            raise FrameError(
                f"expected a policy of the law '{kind.name}', with {1 + kind.axes} axes, got one of "
                f"another law, of shape {frame.values.shape}; start both with the same 'law'"
            )
        if kind.axes == 2 and frame.values.shape[1] != n_a:
            raise FrameError(f"expected gains of {n_a} actuators, got {frame.values.shape[1]}")
        if frame.values.size and np.abs(frame.values).max() > MAX_GAIN:
            raise FrameError(f"expected gains of at most {MAX_GAIN:g} in magnitude")
        run = self._run(frame.run, frame.values.nbytes)
        # One of another shape could never have been used: it puts nothing in doubt.
        shape = frame.values.shape
        before = [p for p in run.policies_of(frame.episode) if p.values.shape == shape]
        if not any(np.array_equal(known.values, frame.values) for known in before):
            run.policies.append(replace(frame, values=frame.values.copy()))
            run.answering = None
            if before:
                raise FrameError(
                    f"two different policies arrived for episode {episode_name(frame.episode)}; "
                    "expected one tuner"
                )
        return self._answer_pending()

    def model(self, frame: Frame) -> list[Publication | ModelFailure]:
        """Take a run's reduced models, as in model_rows.

        Where others came under their number before, those are taken that the start of an episode
        signs. FrameError then; ValueError if they leave no room for U.
        """
        run = self._run(frame.run, 2 * frame.values.nbytes)
        digest, before = digest_of(frame.values), run.models_of(frame.step)
        if digest not in [known.digest for known in before]:
            n_a = self._settings.n_a
            rows = [
                model_rows.unpack(rows.copy(), n_a, self._law_kind.filtered)
                for rows in frame.values
            ]
            laws = laws_of(
                self._law_kind, rows, self._settings.horizon, self._settings.measured_cost
            )
            run.models.append(Models(frame.step, digest, laws))
            run.answering = None
            if before:
                raise FrameError(
                    f"two different sets of reduced models arrived under number {frame.step}; "
                    "expected one tuner"
                )
        return self._answer_pending()

    def state(self, frame: Frame) -> list[Publication | ModelFailure]:
        """Answer the states of an episode's environments, (M, n_z).

        They are kept until everything that the answer needs has arrived, but not two different ones
        of one step. A second, different state of an exploratory episode takes back the models that
        came of the first. ValueError for a state that does not fit the start, and policies or
        models that do not fit it.
        """
        answering = self._answering(frame)
        taken_back: list[ModelFailure] = []
        if answering is None:
            waiting, self._pending = self._pending, None
            if waiting is not None and contradict(waiting, frame):  # the plant repeats its own
                self.counters["different states of one step"] += 1
                return []
            self._pending = replace(frame, values=frame.values.copy())
            self.counters["states that had to wait"] += 1
            return []
        if answering.law is not None:
            before = answering.law.fallbacks
            try:
                actions = answering.law.actions(frame.step, frame.values)
            except MemoryUnknownError as error:
                return [self._unknown(frame, error)]
            self.counters["plans that fell back"] += answering.law.fallbacks - before
            if answering.law.remembers and not self._has_room(frame.run, 0):
                answering.law.forget_answers()
        else:
            exploration = self._runs[frame.run].exploration
            assert exploration is not None
            self._keep_sample(exploration, frame)
            taken_back = exploration.take_back(frame.plant)
            actions = exploration.actions(frame.step)
        self._pending, self._served, self.episode = None, (frame.run, frame.plant), frame.episode
        self.advance_counters(1, frame.step, frame.step)
        time = answering.signature or frame.time
        return [Publication(ACTION, replace(frame, time=time, values=actions)), *taken_back]

    def advance_counters(self, answers: int, step: int, furthest: int) -> None:
        """Count the answered states of the current episode: the last and the furthest."""
        self.answered += answers
        self.step = step
        self._steps.answered((*self._served, self.episode), furthest)

    def answering(self, state: Frame) -> Answering | None:
        """The law that answers the states of an episode, the former one if nothing changed.

        None while anything has to be looked at first: another state waits, or something has arrived
        that changes the answers.
        """
        run = self._runs.get(state.run)
        if run is None or run.episode_start(state) is None or self._pending is not None:
            return None
        if (state.run, state.plant, state.episode) != (*self._served, self.episode):
            return None
        known = run.answering
        same = known is not None and (known.plant, known.episode) == (state.plant, state.episode)
        return known if same else None

    def cost(self, frame: Frame) -> list[Publication | ModelFailure]:
        """Take the end of an episode; of an exploratory one give the models, or why there are none.

        An episode that is void where it was, when by another cost it had gone further, cannot be relied
        on: that is said. FrameError for costs that are not of the episode's shape.
        """
        self._ended = (frame.run, frame.episode)
        if frame.values.shape[1] == len(CostColumn) and len(frame.values):
            completed = frame.values[frame.values[:, CostColumn.ENDED] == COMPLETED]
            self.last_cost = float(completed[:, CostColumn.MEAN].mean()) if len(completed) else None
        run = self._runs.get(frame.run)
        start = run.episode_start(frame) if run else None
        contradiction = self._steps.contradiction(frame)
        if run is None or start is None or run.exploration is None:
            if not contradiction:
                return []
            return [ModelFailure(frame.run, frame.episode, False, contradiction)]
        if frame.values.shape != (len(start.values), len(CostColumn)):
            raise FrameError(
                f"expected costs of shape {(len(start.values), len(CostColumn))}, "
                f"got {frame.values.shape}"
            )
        outcomes = run.exploration.outcomes
        if frame.plant not in outcomes and len(outcomes) < MAX_RUNS:
            found = run.exploration.identify(frame, self._targets.get(frame.plant))
            outcomes[frame.plant] = found
            self.failure = found.reason if isinstance(found, ModelFailure) else ""
            self.counters["identifications failed" if self.failure else "models identified"] += 1
        return [outcomes[frame.plant]] if frame.plant in outcomes else []

    def waits_for(self) -> list[str]:
        """Topics that the state waiting for its answer still lacks; empty when none waits."""
        pending = self._pending
        if pending is None:
            return []
        run = self._runs.get(pending.run, RunState())
        start = run.episode_start(pending)
        lacking = [] if start else ["episode/start"]
        lacking += [] if pending.plant in self._targets else ["target"]
        if start and run.exploration is None:
            models, policies = run.models_of(start.step), run.policies_of(pending.episode)
            lacking += [] if models else ["model"]
            lacking += [] if policies else ["policy"]
            if models and policies and run.inputs_for(start, self._settings.action_set) is None:
                lacking.append("one tuner (different policies or models arrived)")
        return lacking

    def _run(self, number: int, more: int) -> RunState:
        """The record of a run, with room for `more` bytes; FrameError if there is no room."""
        run = self._runs.setdefault(number, RunState())
        forget(self._runs, number, self._served[0])
        if not self._has_room(number, more):
            raise FrameError(f"expected fewer than {MAX_BYTES} bytes for all runs together")
        return run

    def _has_room(self, number: int, more: int) -> bool:
        """Drop less recently used runs than this one, until `more` bytes have room."""
        others = [key for key in self._runs if key not in (number, self._served[0])]
        while sum(run.nbytes for run in self._runs.values()) + more > MAX_BYTES:
            if not others:
                return False
            del self._runs[others.pop(0)]
        return True

    def _keep_sample(self, exploration: Exploration, state: Frame) -> None:
        """Keep a state of an exploratory episode for its identification."""
        if not exploration.lacks(state):
            return
        if self._has_room(state.run, state.values.nbytes + KEPT_ARRAY):
            exploration.keep(state)
        else:
            exploration.give_up(
                f"the states of the exploratory episode take more than {MAX_BYTES} bytes; "
                "explore fewer seeds at once (max_batch)",
                retry=False,
            )

    def _answering(self, frame: Frame) -> Answering | None:
        """The law that answers a state; None while an input is missing."""
        run = self._runs.get(frame.run)
        start = run.episode_start(frame) if run else None
        if run is None or start is None:
            return None
        if len(start.values) != len(frame.values):
            raise FrameError(
                f"expected the states of {len(start.values)} environments, got {len(frame.values)}"
            )
        known, target = run.answering, self._targets.get(frame.plant)
        if known is not None and (known.plant, known.episode) == (frame.plant, frame.episode):
            return known
        if target is None:
            return None
        law, inputs = None, None
        if run.exploration is None:
            if (inputs := run.inputs_for(start, self._settings.action_set)) is None:
                return None
            law = self._law(run, frame.plant, start, inputs, target)
        signed = NOT_SIGNED
        if start.plant:
            digest = digest_of_start(start, inputs, self._settings.action_set)
            signed = signature(digest, target)
        run.answering = Answering(frame.plant, frame.episode, law, signed)
        return run.answering

    def _law(
        self, run: RunState, plant: int, start: Frame, inputs: EpisodeInputs, target: np.ndarray
    ) -> LawBatch:
        """The law set for an episode: the one in use, with its memory, if it is made from the same."""
        policy, models = inputs
        index = start.values[:, StartColumn.MODEL].astype(np.int64)
        if len(policy.values) != len(index):
            raise FrameError(
                f"expected policies for {len(index)} environments, got {len(policy.values)}"
            )
        admissible = self._settings.action_set
        made_from = start.episode, digest_of_start(start, inputs, admissible), digest_of(target)
        known = run.laws.get(plant)
        if known is None or known[0] != made_from:
            law = LawBatch(models.laws, target, admissible)
            law.set(policy.values, index)
            known = made_from, law
        run.use_law(plant, known)
        return known[1]

    def _unknown(self, state: Frame, error: MemoryUnknownError) -> ModelFailure:
        """Message that the episode must be run again, or was contradicted: the memory is unknown."""
        self.counters["states without the memory before"] += 1
        text = f"{error}, on which the memory of the law '{self._law_kind.name}' depends"
        return ModelFailure(state.run, state.episode, not error.contradicted, text)

    def _answer_pending(self) -> list[Publication | ModelFailure]:
        return self.state(self._pending) if self._pending is not None else []
