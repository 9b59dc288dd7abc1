# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A batch cut into chunks, and which of them wait for a pair. Pure."""

from __future__ import annotations

import itertools

import numpy as np

from pdeloop.messages.arrays import Array
from tuner_node.batch import Batch, BatchResult
from tuner_node.chunk import Chunk, gathered
from tuner_node.errors import DispatchError


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
