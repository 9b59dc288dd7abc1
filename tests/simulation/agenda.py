# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What happens when, in virtual time."""

from __future__ import annotations

import heapq
import itertools
import random
from collections.abc import Callable


class Agenda:
    """Events in the order of their times; those of one time in the order in which they were noted.

    rng: draws delays; delay: of a message on average, in virtual seconds.
    """

    def __init__(self, rng: random.Random, delay: float) -> None:
        self.time = 0.0
        self._rng, self._delay = rng, delay
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()

    def __len__(self) -> int:
        return len(self._events)

    def at(self, time: float, event: Callable[[], None]) -> None:
        heapq.heappush(self._events, (time, next(self._numbers), event))

    def later(self, event: Callable[[], None]) -> None:
        """Once a message that is sent now would come."""
        self.at(self.time + self._rng.expovariate(1.0 / self._delay), event)

    def next(self) -> Callable[[], None]:
        """The next event, at its time."""
        self.time, _, event = heapq.heappop(self._events)
        return event
