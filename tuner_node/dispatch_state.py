"""What the dispatcher keeps of its work: the parts of a batch, and the pairs that do them. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.frames import Frame
from loop_interfaces.protocol import Publication
from tuner_node.batch import Batch
from tuner_node.optimizers import Trajectory
from tuner_node.trajectory_collector import Observer

Array = NDArray[np.float64]
REMEMBERED = 16
"""Episodes of a pair whose answers can still be contradicted."""


@dataclass
class Chunk:
    """A part of the batch: rows first..last; `rows` is where its results go."""

    rows: slice
    attempts: int = 0
    costs: Array | None = None
    models: Array | None = None
    trajectories: list[Trajectory] | None = None

    def done(self, batch: Batch) -> bool:
        return (
            self.costs is not None
            and (self.models is not None or not batch.exploratory)
            and (self.trajectories is not None or not batch.trajectories)
        )

    def forget(self) -> None:
        self.costs = self.models = self.trajectories = None


@dataclass
class Pair:
    """One plant and its controller: what it works on, and what the network says of it."""

    missing: tuple[str, ...] = ("plant", "controller")
    chunk: Chunk | None = None
    episode: int = -1
    heard: float = 0.0
    sent: float = 0.0
    observer: Observer = field(default_factory=Observer)
    held: Frame | None = None
    """A cost that waits for the last samples of its trajectories, and since when."""
    held_since: float = 0.0
    strange_since: float = math.inf
    """Since when only another plant's costs come."""
    paused_until: float = -math.inf
    """How long what its plant said of being paused holds."""
    answers: dict[str, dict[int, int]] = field(default_factory=dict)
    """By topic and episode, of the last REMEMBERED: a digest of the answer that was taken."""
    last: Publication | None = None
    """The last start, which keeps the plant for this run while nothing new is handed out."""

    def remember(self, topic: str, answer: Frame) -> None:
        """An answer was taken: another one for its episode contradicts it."""
        known = self.answers.setdefault(topic, {})
        known[answer.episode] = answer.digest()
        if len(known) > REMEMBERED:
            del known[min(known)]
