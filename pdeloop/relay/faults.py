"""What the relay does to each message: a pure function of its random generator. No ROS import."""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Faults:
    """Probabilities of each fault, and the delay in s (each message: uniform in [0, delay])."""

    loss: float = 0.0
    duplicate: float = 0.0
    delay: float = 0.0


@dataclass
class FaultyLine:
    """One direction of a line with faults. Messages with different delays overtake each other."""

    faults: Faults
    rng: np.random.Generator
    lost: int = 0
    duplicated: int = 0
    passed: int = 0
    _queue: list[tuple[float, int, bytes]] = field(default_factory=list)
    _count: itertools.count[int] = field(default_factory=itertools.count)

    def put(self, message: bytes, now: float) -> None:
        """Take a message that arrived at `now` (s)."""
        if self.rng.random() < self.faults.loss:
            self.lost += 1
            return
        copies = 1
        if self.rng.random() < self.faults.duplicate:
            self.duplicated += 1
            copies = 2
        for _ in range(copies):
            due = now + self.faults.delay * self.rng.random()
            heapq.heappush(self._queue, (due, next(self._count), message))

    def due(self, now: float) -> list[bytes]:
        """The messages to pass on at `now`."""
        out = []
        while self._queue and self._queue[0][0] <= now:
            out.append(heapq.heappop(self._queue)[2])
        self.passed += len(out)
        return out

    @property
    def next_due(self) -> float | None:
        """When the next message is due."""
        return self._queue[0][0] if self._queue else None
