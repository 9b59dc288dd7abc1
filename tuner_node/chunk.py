# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Parts of a batch that are one episode each, their results, and which of them wait. Pure."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pdeloop.messages import topics
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame
from pdeloop.messages.protocol import Publication, digest_of
from pdeloop.messages.topics import COMPLETED, CostColumn
from pdeloop.method.adapt import Trajectory
from tuner_node.batch import Batch, BatchResult, DispatchError


@dataclass
class Chunk:
    """A part of the batch: `rows` of it, how often they were started, and their results."""

    rows: slice
    attempts: int = 0
    costs: Array | None = None
    steps: int = 0
    models: Array | None = None
    failure: str = ""
    """Why an exploration gave no model, as the controller says."""
    trajectories: list[Trajectory] | None = None

    @property
    def size(self) -> int:
        """Number of its rows."""
        return int(self.rows.stop - self.rows.start)

    def done(self, batch: Batch) -> bool:
        """True once all results are there that the batch asks for."""
        return (
            self.costs is not None
            and (self.models is not None or bool(self.failure) or not batch.exploratory)
            and (self.trajectories is not None or not batch.trajectories)
        )

    @property
    def completed(self) -> bool:
        """True once costs say that every environment came to its end."""
        return self.costs is not None and bool((self.costs[:, CostColumn.ENDED] == COMPLETED).all())

    def clear(self) -> None:
        """Forget the results."""
        self.costs = self.models = self.trajectories = None
        self.failure = ""


def gathered(
    chunks: Sequence[Chunk], batch: Batch, plant: int, target: Array | None
) -> BatchResult:
    """The results of all chunks, in the batch's order; plant and target: of the run."""
    models = [chunk.models for chunk in chunks if chunk.models is not None]
    if len(models) < len(chunks):  # which of them have one depends on how the batch was cut
        models = []
    seen = [t for chunk in chunks for t in chunk.trajectories or ()]
    return BatchResult(
        np.concatenate([chunk.costs for chunk in chunks if chunk.costs is not None]),
        batch.joined(models),
        plant,
        seen if batch.trajectories else None,
        target,
        frozenset(chunk.steps for chunk in chunks),
    )


def messages_of(
    batch: Batch,
    chunk: Chunk,
    frame: Callable[[Array, int], Frame],
    action_set: ActionSet,
    models_digest: int,
) -> list[Publication]:
    """What asks for the episode of a chunk: the policies, if there are any, and the signed start.

    frame: makes a message of the episode, with values and signature. The policy comes first: it is
    then mostly there when the first state arrives.
    """
    sends, rows = [], batch.rows[chunk.rows]
    signed: list[ArrayLike] = [rows, action_set.signed]
    if batch.policies is not None:
        policies = batch.policies[chunk.rows]
        sends.append(Publication(topics.POLICY, frame(policies, 0)))
        signed += [policies, models_digest]
    return [*sends, Publication(topics.START, frame(rows, digest_of(*signed)))]


class ChunkQueue:
    """The chunks of a batch, in its order, and those that wait, the first to be tried next first.

    batch: the batch; largest: most rows of a chunk; pairs: how many are there to work on it.
    """

    def __init__(self, batch: Batch, largest: int, pairs: int) -> None:
        count, most = len(batch.rows) // batch.together, max(largest // batch.together, 1)
        parts = max(-(-count // most), min(pairs, count), 1)
        edges = (batch.together * np.linspace(0, count, parts + 1).astype(int)).tolist()
        self.batch = batch
        self._chunks = [Chunk(slice(a, b)) for a, b in itertools.pairwise(edges)]
        self.waiting = list(self._chunks)

    def retry(self, chunk: Chunk, reason: str, most: int) -> None:
        """Let a chunk wait again. DispatchError, with the reason, after the last of `most` attempts."""
        chunk.attempts += 1
        if chunk.attempts >= most:
            raise DispatchError(f"gave up after {chunk.attempts} attempts: {reason}")
        self.waiting.append(chunk)

    def result(self, plant: int, target: Array | None) -> BatchResult | None:
        """The result of the batch, of this plant and target; None while a chunk has none."""
        if not all(chunk.done(self.batch) for chunk in self._chunks):
            return None
        return gathered(self._chunks, self.batch, plant, target)
