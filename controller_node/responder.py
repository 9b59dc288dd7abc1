"""The controller's side of the loop: answer every state. Pure: no ROS, no clock.

It answers every state of the episode it was told of, also one it has answered before, and the
answer depends only on (state, policy, model) or, in an exploratory episode, on (seed, step). It
keeps nothing that the latched topics do not give it back after a restart, except the samples of an
exploratory episode: if it missed some, it says so and the episode is run again.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from controller_node.identification import DesignSettings, design
from controller_node.policy import ProjectedLaw, excitation
from loop_interfaces import model_rows
from loop_interfaces.frames import Frame, FrameError
from loop_interfaces.protocol import Counters, ModelFailure, Publication
from loop_interfaces.signature import NOT_SIGNED, design_digest, digest_of, signature
from loop_interfaces.topics import (
    ACTION,
    COMPLETED,
    MAX_GAIN,
    MODEL_IDENTIFIED,
    VOID,
    CostColumn,
    StartColumn,
    start_rows,
)

MAX_KEPT = 8
"""Runs, and plants, whose messages are kept apart. The longest unheard one is forgotten first, but
never the one that was answered last: a flood of strangers cannot push it out."""
KEPT_BYTES = 2**29
"""Bytes that are kept of all runs together. Runs that were heard longer ago are forgotten for a newer
one; a run that has no room alone is refused, and an exploratory episode without room gives no model."""
AHEAD = 32
"""Exploratory actions that are drawn at once, of all environments: well below a millisecond."""


@dataclass
class _Run:
    """What one run's tuner has said, and what was made of it."""

    start: Frame | None = None
    policy: Frame | None = None
    models: list[model_rows.ModelRows] = field(default_factory=list)
    models_digest: int = 0
    generation: int = -1
    """Number of these models; an episode names the one that its policies belong to."""
    laws: dict[int, tuple[ProjectedLaw, int]] = field(default_factory=dict)
    """The law for each plant, and the episode it is set for."""
    signatures: dict[int, float] = field(default_factory=dict)
    """What the actions of the episode carry, by plant."""
    ahead: dict[int, np.ndarray] = field(default_factory=dict)
    """Exploratory actions of some steps of the episode, by step."""
    samples: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)
    """States of an exploratory episode, by (plant, step)."""
    sampled: int = 0
    """Bytes of these."""
    unusable: ModelFailure | None = None
    """Why no model can come out of the exploratory episode, whatever its cost is."""
    disputed: int = -1
    """The episode for which two different policies came."""
    identified: dict[int, Publication | ModelFailure] = field(default_factory=dict)
    """What came out of an exploratory episode, by plant."""

    @property
    def kept(self) -> int:
        """Bytes."""
        frames = [frame.values.nbytes for frame in (self.start, self.policy) if frame is not None]
        models = [a.nbytes for model in self.models for a in (model.U, model.A, model.B)]
        laws = len(self.laws) * sum(model.U.nbytes for model in self.models)
        return sum(frames) + sum(models) + laws + self.sampled

    def begin(self, start: Frame) -> None:
        """An episode begins."""
        self.start = start
        self.samples, self.sampled, self.unusable = {}, 0, None
        self.identified, self.ahead, self.signatures = {}, {}, {}

    def episode_start(self, frame: Frame) -> Frame | None:
        """The start of the frame's episode, if it is the one this run is in."""
        start = self.start
        return start if start is not None and start.episode == frame.episode else None


class Responder:
    """One controller. It answers whichever run the plant serves; runs never share anything."""

    def __init__(self, settings: DesignSettings) -> None:
        self._settings = settings
        self._design = design_digest(asdict(settings))
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
        start = run.start if run else None
        return start is not None and bool(start.values[0, StartColumn.EXCITATION] >= 0)

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
        """Learn of an episode: who explores, which model each environment uses."""
        rows = start_rows(frame)
        if not len(rows):
            self._runs.pop(frame.run, None)
            return []
        run = self._run(frame.run, rows.nbytes)
        if run.episode_start(frame) is None:
            run.begin(replace(frame, values=rows.copy()))
            self.failure = ""
        elif run.identified:
            return list(
                run.identified.values()
            )  # asked again: what was answered may have been lost
        return self._answer_pending()

    def policy(self, frame: Frame) -> list[Publication]:
        """Take the policies [K_a K_b] of an episode's environments."""
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
            run.signatures[state.plant] = signature(self._told(run, start), target)
        return run.signatures[state.plant]

    def _told(self, run: _Run, start: Frame) -> int:
        """D: what the tuner said of an episode; 0 if it asks for no signature."""
        told: list[Any] = [start.values, self._settings.action_limit]
        if start.values[0, StartColumn.EXCITATION] < 0 and run.policy is not None:
            told += [run.policy.values, run.models_digest]
        return digest_of(*told) if start.plant else 0

    def law_for(self, state: Frame) -> ProjectedLaw | None:
        """The law that answers the states of an episode, like one that was answered before.

        None where the controller explores, and while anything has to be looked at first: another
        state waits, or something has arrived that changes the law.
        """
        run = self._runs.get(state.run)
        start = run.episode_start(state) if run else None
        if run is None or start is None or self._pending is not None:
            return None
        if (state.run, state.plant, state.episode) != (*self._served, self.episode):
            return None
        law, episode = run.laws.get(state.plant, (None, -1))
        explores = start.values[0, StartColumn.EXCITATION] >= 0
        return None if explores or episode != state.episode else law

    def cost(self, frame: Frame) -> list[Publication | ModelFailure]:
        """At the end of an exploratory episode: reduce and design."""
        self._ended = (frame.run, frame.episode)
        if frame.values.shape[1] == len(CostColumn) and len(frame.values):
            completed = frame.values[frame.values[:, CostColumn.ENDED] == COMPLETED]
            self.last_cost = float(completed[:, CostColumn.MEAN].mean()) if len(completed) else None
        run = self._runs.get(frame.run)
        start = run.episode_start(frame) if run else None
        if run is None or start is None or start.values[0, StartColumn.EXCITATION] < 0:
            return []
        if frame.values.shape != (len(start.values), len(CostColumn)):
            raise FrameError(
                f"expected costs of shape {(len(start.values), len(CostColumn))}, "
                f"got {frame.values.shape}"
            )
        if frame.plant not in run.identified and len(run.identified) < MAX_KEPT:
            found = run.identified[frame.plant] = self._identify(run, start, frame)
            failed = isinstance(found, ModelFailure)
            self.failure = found.reason if isinstance(found, ModelFailure) else ""
            self.counters["identifications failed" if failed else "models identified"] += 1
        return [run.identified[frame.plant]] if frame.plant in run.identified else []

    def waits_for(self) -> list[str]:
        """Topics that the state waiting for its answer still lacks; empty when none waits."""
        pending = self._pending
        if pending is None:
            return []
        run = self._runs.get(pending.run, _Run())
        start = run.episode_start(pending)
        lacking = [] if start else ["episode/start"]
        lacking += [] if pending.plant in self._targets else ["target"]
        if start and start.values[0, StartColumn.EXCITATION] < 0:
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
            raise FrameError(f"expected less than {KEPT_BYTES} bytes of all runs together")
        return run

    def _has_room(self, number: int, more: int) -> bool:
        """Forget runs that were heard longer ago than this one, until `more` bytes have room."""
        others = [key for key in self._runs if key not in (number, self._served[0])]
        while sum(run.kept for run in self._runs.values()) + more > KEPT_BYTES:
            if not others:
                return False
            del self._runs[others.pop(0)]
        return True

    def _keep_sample(self, run: _Run, frame: Frame) -> None:
        """A state of an exploratory episode, for its identification."""
        known = run.samples.get((frame.plant, frame.step))
        again = known is not None and np.array_equal(known, frame.values)
        if run.unusable is not None or again:
            return
        size = frame.values.nbytes
        if known is not None:
            reason = f"two different states came for step {frame.step} of the exploratory episode"
            run.unusable = ModelFailure(frame.run, frame.episode, True, reason)
        elif self._has_room(frame.run, size):
            run.samples[frame.plant, frame.step] = frame.values.copy()
            run.sampled += size
            return
        else:
            reason = (
                f"the states of the exploratory episode take more than {KEPT_BYTES} bytes; "
                "explore fewer seeds at once (max_batch)"
            )
            run.unusable = ModelFailure(frame.run, frame.episode, False, reason)
        run.samples, run.sampled = {}, 0

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
        if start.values[0, StartColumn.EXCITATION] >= 0:
            self._keep_sample(run, frame)
            return self._exploratory(run, start, frame.step)
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

    def _exploratory(self, run: _Run, start: Frame, step: int) -> np.ndarray:
        """The actions of one step; those of the next ones are drawn with them.

        To make a generator of random numbers takes several times as long in between as again at once.
        """
        if step not in run.ahead:
            steps = range(step, step + max(1, AHEAD // len(start.values)))
            run.ahead = {
                k: np.stack([self._explore(*how, k) for how in _excitations(start)]) for k in steps
            }
        return run.ahead[step]

    def _explore(self, seed: int, variance: float, step: int) -> np.ndarray:
        settings = self._settings
        return excitation(seed, step, settings.n_a, variance, settings.action_limit)

    def _identify(self, run: _Run, start: Frame, cost: Frame) -> Publication | ModelFailure:
        def failure(retry: bool, reason: str) -> ModelFailure:
            return ModelFailure(start.run, start.episode, retry, reason)

        ended = cost.values[:, CostColumn.ENDED]
        if (ended == VOID).any() or len(ended) != len(start.values):
            return failure(True, "the exploratory episode is void")
        if (ended != COMPLETED).any():
            return failure(
                False,
                f"the plant diverged under exploration at step {int(ended.max())}; "
                "lower exploration_variance",
            )
        if run.unusable is not None:
            return run.unusable
        held = {step: z for (plant, step), z in run.samples.items() if plant == cost.plant}
        if len(held) != cost.step + 1 or max(held) != cost.step:
            return failure(
                True,
                f"the controller holds {len(held)} of the {cost.step + 1} states "
                "of the exploratory episode",
            )
        steps = range(cost.step + 1)
        target = self._targets.get(cost.plant)
        if target is None:  # as none of its states was answered, somebody else did
            return failure(True, "the plant's target has not arrived")
        states = np.stack([held[k] for k in steps])
        try:
            models = []
            for env, how in enumerate(_excitations(start)):
                actions = np.stack([self._explore(*how, k) for k in steps[:-1]])
                models.append(design([(states[:, env], actions)], target, self._settings))
        except ValueError as error:
            return failure(False, str(error))
        rows = np.stack([model_rows.pack(model) for model in models])
        time = signature(self._told(run, start), self._design) or cost.time
        return Publication(MODEL_IDENTIFIED, replace(cost, step=0, time=time, values=rows))

    def _answer_pending(self) -> list[Publication]:
        return self.state(self._pending) if self._pending is not None else []


def _excitations(start: Frame) -> list[tuple[int, float]]:
    """Seed and variance of every environment's exploratory actions."""
    columns = start.values[:, [StartColumn.EXCITATION, StartColumn.VARIANCE]]
    return [(int(seed), float(variance)) for seed, variance in columns]


def _forget(kept: OrderedDict[int, Any], newest: int, protected: int) -> None:
    """Keep MAX_KEPT entries: `newest`, `protected`, and the most recently heard others."""
    kept.move_to_end(newest)
    if len(kept) > MAX_KEPT:
        del kept[next(key for key in kept if key not in (newest, protected))]
