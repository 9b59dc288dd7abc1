"""The controller's side of the loop: answer every state. Pure: no ROS, no clock.

It answers every state of an episode whose start it has, also one it has answered before, and the
answer depends only on (state, policy, model) or, in an exploratory episode, on (seed, step). It
keeps nothing that the latched topics do not give it back after a restart, except the samples of an
exploratory episode: if it missed some, it says so and the episode is run again.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from controller_node.exploration import Exploration
from controller_node.identification import DesignSettings
from controller_node.policy import ProjectedLaw
from loop_interfaces import model_rows
from loop_interfaces.frames import Frame, FrameError
from loop_interfaces.protocol import Counters, ModelFailure, Publication
from loop_interfaces.signature import NOT_SIGNED, digest_of, signature
from loop_interfaces.topics import (
    ACTION,
    COMPLETED,
    MAX_GAIN,
    CostColumn,
    StartColumn,
    start_rows,
)

MAX_RUNS = 8
"""Runs, and plants, that are remembered. The longest unheard one is forgotten first, but never the one
that was answered last: a flood of strangers cannot push it out."""
MAX_BYTES = 2**29
"""Bytes that are kept of all runs together. Runs that were heard longer ago are forgotten for a newer
one; a run that has no room alone is refused, and an exploratory episode without room gives no model."""


@dataclass
class _Run:
    """What one run's tuner has sent, and what was made of it."""

    start: Frame | None = None
    exploration: Exploration | None = None
    """Of the episode, if it explores."""
    policy: Frame | None = None
    disputed: int = -1
    """The episode for which two different policies came."""
    models: list[model_rows.ModelRows] = field(default_factory=list)
    models_digest: int = 0
    generation: int = -1
    """Number of these models; an episode names the one that its policies belong to."""
    laws: dict[int, tuple[ProjectedLaw, int]] = field(default_factory=dict)
    """The law for each plant, and the episode it is set for."""
    signatures: dict[int, float] = field(default_factory=dict)
    """What the actions of the episode carry, by plant."""

    @property
    def nbytes(self) -> int:
        frames = [frame.values.nbytes for frame in (self.start, self.policy) if frame is not None]
        models = [a.nbytes for model in self.models for a in (model.U, model.A, model.B)]
        laws = len(self.laws) * sum(model.U.nbytes for model in self.models)
        samples = self.exploration.nbytes if self.exploration else 0
        return sum(frames) + sum(models) + laws + samples

    def episode_start(self, frame: Frame) -> Frame | None:
        """The start of the frame's episode, if it is the one this run is in."""
        start = self.start
        return start if start is not None and start.episode == frame.episode else None


class Responder:
    """One controller. It answers whichever run the plant serves; runs never share anything."""

    def __init__(self, settings: DesignSettings) -> None:
        self._settings = settings
        self._targets: OrderedDict[int, np.ndarray] = OrderedDict()
        self._runs: OrderedDict[int, _Run] = OrderedDict()
        self._served = (-1, -1)
        """Run and plant of the last answer."""
        self._pending: Frame | None = None
        self.counters = Counters()
        self.answered = 0
        self.episode = self.step = -1
        """Of the last answer."""
        self.last_cost: float | None = None
        """Mean stage cost of the last episode's environments."""
        self.failure = ""
        """Why the last episode's identification gave no model; empty if it did."""
        self._ended = (-1, -1)
        """Run and episode of the last cost."""

    @property
    def run(self) -> int | None:
        """The run that was answered last."""
        return self._served[0] if self._served[0] >= 0 else None

    @property
    def under_way(self) -> bool:
        """Whether the episode that was answered last goes on."""
        run = self._served[0]
        return run in self._runs and (run, self.episode) != self._ended

    @property
    def exploring(self) -> bool:
        """Whether the episode that was answered last explores."""
        run = self._runs.get(self._served[0])
        return run is not None and run.exploration is not None

    def target(self, frame: Frame) -> list[Publication]:
        """Take the target z_r of a plant."""
        self._targets[frame.plant] = frame.values.copy()
        _forget(self._targets, frame.plant, self._served[1])
        for run in self._runs.values():
            known = set(run.laws) & set(self._targets) - {frame.plant}
            run.laws = {plant: run.laws[plant] for plant in known}
            run.signatures = {}
        return self._answer_pending()

    def start(self, frame: Frame) -> Sequence[Publication | ModelFailure]:
        """Take the start of an episode: whether it explores, and which model each environment uses."""
        rows = start_rows(frame)
        if not len(rows):
            self._runs.pop(frame.run, None)
            return []
        run = self._run(frame.run, rows.nbytes)
        if run.episode_start(frame) is None:
            run.start, run.signatures = replace(frame, values=rows.copy()), {}
            explores = rows[0, StartColumn.EXCITATION] >= 0
            run.exploration = Exploration(run.start, self._settings) if explores else None
            self.failure = ""
        elif run.exploration and run.exploration.outcomes:
            return list(run.exploration.outcomes.values())  # the answer may have been lost
        return self._answer_pending()

    def policy(self, frame: Frame) -> list[Publication]:
        """Take the policies [K_a K_b] of an episode's environments, (M, n_a, 2 n_s)."""
        n_a = self._settings.n_a
        if frame.values.shape[1] != n_a:
            raise FrameError(f"expected gains of {n_a} actuators, got {frame.values.shape[1]}")
        if frame.values.size and np.abs(frame.values).max() > MAX_GAIN:
            raise FrameError(f"expected gains of at most {MAX_GAIN:g} in magnitude")
        run = self._run(frame.run, frame.values.nbytes)
        known = run.policy
        shape = frame.values.shape
        # One of another shape could never have been used: it puts nothing in doubt.
        if known and known.episode == frame.episode and known.values.shape == shape:
            if np.array_equal(known.values, frame.values):
                return self._answer_pending()
            run.disputed, run.laws = frame.episode, {}
            raise FrameError(
                f"two different policies came for episode {frame.episode}, which is therefore not "
                "answered; expected one tuner"
            )
        run.policy, run.signatures = replace(frame, values=frame.values.copy()), {}
        run.laws = {plant: (law, -1) for plant, (law, _) in run.laws.items()}
        return self._answer_pending()

    def model(self, frame: Frame) -> list[Publication]:
        """Take a run's reduced models."""
        run = self._run(frame.run, 2 * frame.values.nbytes)
        run.models = [model_rows.unpack(rows.copy(), self._settings.n_a) for rows in frame.values]
        run.models_digest = digest_of(frame.values)
        run.generation, run.laws, run.signatures = frame.step, {}, {}
        return self._answer_pending()

    def state(self, frame: Frame) -> list[Publication]:
        """The action that answers a state; the state is kept until what it needs has arrived."""
        actions = self._actions(frame)
        if actions is None:
            self._pending = replace(frame, values=frame.values.copy())
            self.counters["states that had to wait"] += 1
            return []
        self._pending = None
        self._served = (frame.run, frame.plant)
        self.episode = frame.episode
        self.advance_counters(1, frame.step)
        time = self.signature_for(frame) or frame.time
        answer = Frame(frame.run, frame.episode, frame.step, time, actions, frame.plant)
        return [Publication(ACTION, answer)]

    def advance_counters(self, answers: int, step: int) -> None:
        """Account for states of the present episode, up to `step`, that were answered."""
        self.answered += answers
        self.step = step

    def signature_for(self, state: Frame) -> float:
        """What the actions carry that answer the states of an episode, like one that was answered."""
        run = self._runs[state.run]
        start = run.episode_start(state)
        if start is None or not start.plant:
            return NOT_SIGNED
        if state.plant not in run.signatures:
            target = self._targets[state.plant]
            run.signatures[state.plant] = signature(self._digest(run, start), target)
        return run.signatures[state.plant]

    def _digest(self, run: _Run, start: Frame) -> int:
        """D: what the tuner published of an episode."""
        published: list[Any] = [start.values, self._settings.action_limit]
        if run.exploration is None and run.policy is not None:
            published += [run.policy.values, run.models_digest]
        return digest_of(*published)

    def law_for(self, state: Frame) -> ProjectedLaw | None:
        """The law that answers the states of an episode, like one that was answered before.

        None where the controller explores, and while anything has to be looked at first: another
        state waits, or something has arrived that changes the law.
        """
        run = self._runs.get(state.run)
        if run is None or run.episode_start(state) is None or self._pending is not None:
            return None
        if (state.run, state.plant, state.episode) != (*self._served, self.episode):
            return None
        law, episode = run.laws.get(state.plant, (None, -1))
        return law if run.exploration is None and episode == state.episode else None

    def cost(self, frame: Frame) -> list[Publication | ModelFailure]:
        """At the end of an exploratory episode: reduce and design."""
        self._ended = (frame.run, frame.episode)
        if frame.values.shape[1] == len(CostColumn) and len(frame.values):
            completed = frame.values[frame.values[:, CostColumn.ENDED] == COMPLETED]
            self.last_cost = float(completed[:, CostColumn.MEAN].mean()) if len(completed) else None
        run = self._runs.get(frame.run)
        start = run.episode_start(frame) if run else None
        if run is None or start is None or run.exploration is None:
            return []
        if frame.values.shape != (len(start.values), len(CostColumn)):
            raise FrameError(
                f"expected costs of shape {(len(start.values), len(CostColumn))}, "
                f"got {frame.values.shape}"
            )
        outcomes = run.exploration.outcomes
        if frame.plant not in outcomes and len(outcomes) < MAX_RUNS:
            found = run.exploration.identify(frame, self._targets.get(frame.plant))
            outcomes[frame.plant] = found
            failed = isinstance(found, ModelFailure)
            self.failure = found.reason if isinstance(found, ModelFailure) else ""
            self.counters["identifications failed" if failed else "models identified"] += 1
        return [outcomes[frame.plant]] if frame.plant in outcomes else []

    def waits_for(self) -> list[str]:
        """Topics that the state waiting for its answer still lacks; empty when none waits."""
        pending = self._pending
        if pending is None:
            return []
        run = self._runs.get(pending.run, _Run())
        start = run.episode_start(pending)
        lacking = [] if start else ["episode/start"]
        lacking += [] if pending.plant in self._targets else ["target"]
        if start and run.exploration is None:
            lacking += [] if run.models and run.generation == start.step else ["model"]
            if run.policy is None or run.policy.episode != pending.episode:
                lacking.append("policy")
            elif run.disputed == pending.episode:
                lacking.append("policy (two different ones came)")
        return lacking

    def _run(self, number: int, more: int) -> _Run:
        """What is known of a run, of which `more` bytes come. FrameError if there is no room."""
        run = self._runs.setdefault(number, _Run())
        _forget(self._runs, number, self._served[0])
        if not self._has_room(number, more):
            raise FrameError(f"expected less than {MAX_BYTES} bytes of all runs together")
        return run

    def _has_room(self, number: int, more: int) -> bool:
        """Forget runs that were heard longer ago than this one, until `more` bytes have room."""
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
        if self._has_room(state.run, state.values.nbytes):
            exploration.keep(state)
            return
        reason = (
            f"the states of the exploratory episode take more than {MAX_BYTES} bytes; "
            "explore fewer seeds at once (max_batch)"
        )
        exploration.give_up(reason, retry=False)

    def _actions(self, frame: Frame) -> np.ndarray | None:
        run = self._runs.get(frame.run)
        start = run.episode_start(frame) if run else None
        if run is None or start is None:
            return None
        if len(start.values) != len(frame.values):
            raise FrameError(
                f"expected the states of {len(start.values)} environments, got {len(frame.values)}"
            )
        target = self._targets.get(frame.plant)
        if target is None:
            return None
        if run.exploration:
            self._keep_sample(run.exploration, frame)
            return run.exploration.actions(frame.step)
        law, episode = run.laws.get(frame.plant, (None, -1))
        if law is None or episode != frame.episode:
            law = self._prepare(run, start, law, target, self._settings.action_limit)
            if law is None:
                return None
            run.laws[frame.plant] = (law, frame.episode)
        return law.actions(frame.values)

    @staticmethod
    def _prepare(
        run: _Run,
        start: Frame,
        law: ProjectedLaw | None,
        target: np.ndarray,
        action_limit: float,
    ) -> ProjectedLaw | None:
        """The law set for the run's episode; None while something has not arrived yet."""
        policy = run.policy
        if policy is None or policy.episode != start.episode or run.disputed == start.episode:
            return None
        if not run.models or run.generation != start.step:
            return None
        if law is None:
            law = ProjectedLaw([model.U for model in run.models], target, action_limit)
        index = start.values[:, StartColumn.MODEL].astype(np.int64)
        if len(policy.values) != len(index):
            raise FrameError(
                f"expected policies for {len(index)} environments, got {len(policy.values)}"
            )
        law.set(policy.values, index)
        return law

    def _answer_pending(self) -> list[Publication]:
        return self.state(self._pending) if self._pending is not None else []


def _forget(known: OrderedDict[int, Any], newest: int, protected: int) -> None:
    """Keep MAX_RUNS entries: `newest`, `protected`, and the most recently heard others."""
    known.move_to_end(newest)
    if len(known) > MAX_RUNS:
        del known[next(key for key in known if key not in (newest, protected))]
