# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A pair of plant and controller as seen by the dispatcher, and contradictions to it. Pure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import KEPT_ARRAY, Frame, FrameError, digest
from pdeloop.messages.protocol import NOT_SIGNED, ModelFailure, Publication, signature, signature_in
from pdeloop.messages.topics import COMPLETED, COST, MODEL_FAILED, VOID, CostColumn, episode_name
from pdeloop.method.adapt import Trajectory
from pdeloop.method.adapt.trajectories import kept
from tuner_node.batch import Batch, ContradictionError, DispatchError, NoModelError, less_often
from tuner_node.chunk import Chunk

MAX_BYTES = 2**30
"""Most bytes kept of the samples of one episode."""


@dataclass
class TrajectoryCollector:
    """The samples of one episode of one pair, by (plant, step).

    A lost sample is never interpolated: the episode has no trajectories, and is run again. The same
    holds if two samples of a step differ, because it is unknown which of them was the plant's.
    """

    run: int = -1
    episode: int = -1
    contradiction: str = ""
    """Why the episode cannot be used, if two different samples came for one step."""
    used: bool = False
    """True once the trajectories were taken: what comes now is only compared."""
    nbytes: int = 0
    """Size of the samples that are kept, and of what keeps them."""
    _samples: dict[str, dict[tuple[int, int], Array]] = field(
        default_factory=lambda: {"states": {}, "actions": {}}
    )

    def take(self, what: str, frame: Frame) -> None:
        """Take a sample z_k ("states") or a_k ("actions"). FrameError if there is no room for it."""
        if (frame.run, frame.episode) != (self.run, self.episode):
            return
        known, key = self._samples[what], (frame.plant, frame.step)
        if key not in known:
            if self.used:
                return
            size = frame.values.nbytes + KEPT_ARRAY
            if self.nbytes + size > MAX_BYTES:
                raise FrameError(
                    f"expected at most {MAX_BYTES} bytes of samples of one episode; if they are all "
                    "of this run's plant, lower max_batch"
                )
            known[key], self.nbytes = frame.values.copy(), self.nbytes + size
        elif not np.array_equal(known[key], frame.values):
            self.contradiction = (
                f"two different {what} arrived for step {frame.step} of episode "
                f"{episode_name(frame.episode)}"
            )

    def lost(self, plant: int, steps: int, n_z: int) -> int:
        """Number of missing samples z_0..z_T, of n_z numbers each, and a_0..a_{T-1}."""
        states: int = sum(
            p == plant and k <= steps and values.shape[1] == n_z
            for (p, k), values in self._samples["states"].items()
        )
        actions = sum(p == plant and k < steps for p, k in self._samples["actions"])
        return 2 * steps + 1 - states - actions

    def trajectories(self, plant: int, steps: int, ended: Array) -> list[Trajectory]:
        """The trajectory of every environment; one that diverged at step k ends with z_k.

        ended (M,): as in CostColumn.ENDED. Only when `lost` says that nothing is missing.
        """
        self.used = True
        states = [self._samples["states"][plant, k] for k in range(steps + 1)]
        actions = [self._samples["actions"][plant, k] for k in range(steps)]
        return cut(states, actions, ended)


def cut(
    states: Array | Sequence[Array], actions: Array | Sequence[Array], ended: Array
) -> list[Trajectory]:
    """The trajectories of the M environments of an episode, each up to where it ended.

    states T+1 of (M, n_z), actions T of (M, n_a), ended (M,).
    """
    steps = len(actions)
    last = [steps if end == COMPLETED else int(end) for end in ended]
    return [
        kept(
            np.array([z[m] for z in states[: k + 1]]),
            np.array([a[m] for a in actions[:k]]).reshape(k, actions[0].shape[1]),
        )
        for m, k in enumerate(last)
    ]


PairPublication = tuple[int, Publication]
"""(pair, message): publish the message in that pair's namespace."""
REMEMBERED = 16
"""Episodes of a pair whose answers can still be contradicted."""


FOREIGN_PLANT_GRACE = 20.0
"""Seconds with costs of another plant only, after which the run stops."""


@dataclass
class Pair:
    """One plant and its controller: what they work on, and whether they are there."""

    number: int
    missing: tuple[str, ...] = ("plant", "controller")
    chunk: Chunk | None = None
    """The chunk that it works on; None while it is free."""
    run: int = -1
    episode: int = -1
    last_heard: float = 0.0
    last_sent: float = 0.0
    repeats: int = 0
    """How often it was asked again for what is under way."""
    samples: TrajectoryCollector = field(default_factory=TrajectoryCollector)
    former_samples: TrajectoryCollector = field(default_factory=TrajectoryCollector)
    """Samples of the previous episode, which a late one can still contradict."""
    pending_cost: Frame | None = None
    """The cost of the episode, while the last samples of its trajectories are missing."""
    pending_since: float = 0.0
    announced: set[int] = field(default_factory=set)
    """The plants whose targets came."""
    foreign_since: float = math.inf
    """Since when only another plant's costs come."""
    paused_until: float = -math.inf
    """End of the validity of the plant's report that it is paused."""
    answers: dict[tuple[str, int], tuple[int, int]] = field(default_factory=dict)
    """By topic and episode: a digest of the answer that was taken, and its step."""
    signed: dict[int, int] = field(default_factory=dict)
    """D of the last episodes, see pdeloop.messages.protocol."""
    last_start: Publication | None = None
    """Sent again while nothing new is begun, to keep the plant for this run."""

    def begin(self, chunk: Chunk, run: int, episode: int, now: float) -> None:
        """It works on a chunk from now on."""
        self.chunk, self.run, self.episode, self.last_heard = chunk, run, episode, now
        self.repeats = 0
        self.former_samples, self.samples = self.samples, TrajectoryCollector(run, episode)

    def drop(self) -> Chunk:
        """It does not work on its chunk any more, whose results are forgotten."""
        chunk = self.chunk
        assert chunk is not None
        chunk.clear()
        self.chunk = self.pending_cost = None
        return chunk

    def release_if_done(self, batch: Batch) -> None:
        """It is free if its chunk has all results.

        NoModelError if an exploration gave no model although the plant did not diverge.
        """
        chunk = self.chunk
        if chunk is not None and chunk.failure and chunk.completed:
            raise NoModelError(f"no reduced model: {chunk.failure}")
        if chunk is not None and chunk.done(batch):
            self.chunk = None

    def started(self, start: Publication) -> None:
        """A start is published."""
        self.last_start = start
        self.signed[start.frame.episode] = start.frame.plant
        if len(self.signed) > REMEMBERED:
            oldest = min(self.signed)
            del self.signed[oldest]
            self.answers = {key: known for key, known in self.answers.items() if key[1] > oldest}

    def less_often(self, state_size: int, now: float) -> int:
        """How many times less often it is asked again for an episode, whose answer may be large.

        A paused plant waits for starts.
        """
        if self.chunk is None or now < self.paused_until:
            return 1
        return less_often(self.chunk.size * state_size)

    def take_answer(self, topic: str, answer: Frame) -> None:
        """An answer is used: another one for its episode contradicts it."""
        self.answers[topic, answer.episode] = digest(answer.values), answer.step

    def take_failure(self, failure: ModelFailure) -> None:
        """The exploration under way gave no model; that is said again when it is asked for again."""
        assert self.chunk is not None
        self.chunk.failure = failure.reason
        self.answers[MODEL_FAILED, failure.episode] = 0, 0

    def runs(self, episode: int) -> bool:
        """True while this episode is under way."""
        return self.chunk is not None and self.episode == episode

    def used(self, episode: int) -> bool:
        """True if an answer to this one of the last episodes was taken."""
        return any(known == episode for _, known in self.answers)

    def check_answer(self, answer: Frame, topic: str) -> None:
        """Raise ContradictionError if its episode was answered already, and otherwise.

        It is then chance which of the two answers was taken.
        """
        if (topic, answer.episode) not in self.answers:
            return
        taken, step = self.answers[topic, answer.episode]
        void = topic == COST.name and bool((answer.values[:, -1:] == VOID).any())
        if not void and digest(answer.values) != taken:
            raise ContradictionError(
                f"two different messages on {topic} answer episode {episode_name(answer.episode)}; "
                "expected one plant and one controller in this namespace: stop the other and start a "
                "new run"
            )
        # A plant that was started anew runs its last episode again, and may not come to its end: that
        # is void at an earlier step.
        if void and answer.step == step and not self.runs(answer.episode):
            raise ContradictionError(
                f"the plant withdrew the cost of episode {episode_name(answer.episode)}, which "
                "this run has used, because different starts or actions arrived: stop the second "
                "tuner or controller and start a new run"
            )

    def check_failure(self, failure: ModelFailure) -> None:
        """Raise ContradictionError if an episode that was used is taken back."""
        # With `retry` the controller has only lost what it knew.
        repeated = (MODEL_FAILED, failure.episode) in self.answers
        if not failure.retry and not repeated and self.used(failure.episode):
            raise ContradictionError(
                f"the controller withdrew episode {episode_name(failure.episode)}, which this run "
                f"has used, because {failure.reason}; stop the other publisher in this namespace "
                "and start a new run"
            )

    def check_signature(self, model: Frame, design: int) -> None:
        """Raise FrameError if a model is signed for other parameters than these (design: a digest)."""
        signed = self.signed.get(model.episode, 0)
        if signed and signature_in(model.time) not in (NOT_SIGNED, signature(signed, design)):
            raise FrameError(
                "expected a model identified with the parameters of this run's tuner; stop the other "
                "controller, or start both with the same parameters"
            )

    def check_plant(self, cost: Frame, plant: int, now: float) -> None:
        """A FrameError unless a cost is of this plant.

        A DispatchError after FOREIGN_PLANT_GRACE, if this plant has not been present.
        """
        foreign = cost.plant != plant and plant not in self.announced
        self.foreign_since = min(self.foreign_since, now) if foreign else math.inf
        if now - self.foreign_since > FOREIGN_PLANT_GRACE:
            raise DispatchError(
                f"the plant has other parameters (fingerprint {cost.plant}) than the one this run "
                f"began with ({plant}); continue with that plant, or start a new run"
            )
        if cost.plant != plant:
            raise FrameError(
                f"the cost of episode {episode_name(cost.episode)} comes from a plant with other "
                f"parameters (fingerprint {cost.plant}) than this run's ({plant}); stop that plant"
            )

    def sample(self, what: str, frame: Frame, width: int) -> None:
        """Take a sample of its episode: "states" or "actions". FrameError if their number is wrong."""
        for late in self.used_samples():
            late.take(what, frame)
        if self.chunk is None or frame.run != self.run or not self.runs(frame.episode):
            return
        if frame.values.shape != (expected := (self.chunk.size, width)):
            raise FrameError(
                f"expected a sample of shape {expected} for step {frame.step}, "
                f"got {frame.values.shape}"
            )
        self.samples.take(what, frame)

    def used_samples(self) -> list[TrajectoryCollector]:
        """Samples of the last two episodes, if they were used."""
        return [known for known in (self.samples, self.former_samples) if known.used]

    def lost_samples(self, n_z: int) -> int:
        """Number of missing samples of the episode that has its cost."""
        cost = self.pending_cost
        return self.samples.lost(cost.plant, cost.step, n_z) if cost is not None else 0

    def take_trajectories(self) -> None:
        """The samples are all there: they become trajectories of the chunk."""
        cost, chunk = self.pending_cost, self.chunk
        assert cost is not None and chunk is not None
        ended = cost.values[:, CostColumn.ENDED]
        chunk.trajectories = self.samples.trajectories(cost.plant, cost.step, ended)
        self.pending_cost = None
