"""The state of the dispatcher: the chunks of a batch, and the pairs that run them. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.frames import Frame, digest
from loop_interfaces.protocol import Publication
from tuner_node.batch import Batch
from tuner_node.optimizers import Trajectory
from tuner_node.trajectory_collector import TrajectoryCollector

Array = NDArray[np.float64]
REMEMBERED = 16
"""Episodes of a pair whose answers can still be contradicted."""


@dataclass
class Chunk:
    """A part of the batch: `rows` of it, how often they were started, and their results."""

    rows: slice
    attempts: int = 0
    costs: Array | None = None
    models: Array | None = None
    trajectories: list[Trajectory] | None = None

    @property
    def size(self) -> int:
        """How many rows it has."""
        size: int = self.rows.stop - self.rows.start
        return size

    def done(self, batch: Batch) -> bool:
        """Whether all results are there that the batch asks for."""
        return (
            self.costs is not None
            and (self.models is not None or not batch.exploratory)
            and (self.trajectories is not None or not batch.trajectories)
        )

    def clear(self) -> None:
        """Forget the results."""
        self.costs = self.models = self.trajectories = None


@dataclass
class Pair:
    """One plant and its controller: what they work on, and whether they are there."""

    missing: tuple[str, ...] = ("plant", "controller")
    chunk: Chunk | None = None
    episode: int = -1
    last_heard: float = 0.0
    last_sent: float = 0.0
    samples: TrajectoryCollector = field(default_factory=TrajectoryCollector)
    former_samples: TrajectoryCollector = field(default_factory=TrajectoryCollector)
    """Of the episode before: one that comes late can still contradict them."""
    pending_cost: Frame | None = None
    """The cost of the episode, while the last samples of its trajectories are missing."""
    pending_since: float = 0.0
    foreign_since: float = math.inf
    """Since when only another plant's costs come."""
    paused_until: float = -math.inf
    """How long the plant's report that it is paused holds."""
    answers: dict[str, dict[int, int]] = field(default_factory=dict)
    """By topic and episode, of the last REMEMBERED: a digest of the answer that was taken."""
    signed: dict[int, int] = field(default_factory=dict)
    """D of the last REMEMBERED episodes, see loop_interfaces.signature."""
    last_start: Publication | None = None
    """Sent again while nothing new is begun, to keep the plant for this run."""

    def remember(self, topic: str, answer: Frame) -> None:
        """An answer was taken: another one for its episode contradicts it."""
        known = self.answers.setdefault(topic, {})
        known[answer.episode] = digest(answer.values)
        _forget(known)

    def used_samples(self) -> list[TrajectoryCollector]:
        """Of the last two episodes, if they were used."""
        return [known for known in (self.samples, self.former_samples) if known.used]

    def begin(self, start: Publication) -> None:
        """A start is published."""
        self.last_start = start
        self.signed[start.frame.episode] = start.frame.plant
        _forget(self.signed)


def _forget(known: dict[int, int]) -> None:
    if len(known) > REMEMBERED:
        del known[min(known)]
