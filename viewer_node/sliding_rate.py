"""How fast a count grows, over the last seconds. Pure."""

from __future__ import annotations

from collections import deque

WINDOW = 3.0
"""Seconds over which a rate is taken."""


class SlidingRate:
    """A count that grows, and how fast it grew over the last WINDOW."""

    def __init__(self) -> None:
        self._total = 0.0
        self._marks: deque[tuple[float, float]] = deque()

    def add(self, count: float, now: float) -> None:
        """Count `count` more."""
        if not self._marks:
            self._marks.append((now, 0.0))
        self._total += count
        if now - self._marks[-1][0] > 0.02:
            self._marks.append((now, self._total))

    def per_second(self, now: float) -> float:
        """The rate in 1/s."""
        while len(self._marks) > 1 and now - self._marks[0][0] > WINDOW:
            self._marks.popleft()
        if not self._marks:
            return 0.0
        since, before = self._marks[0]
        return (self._total - before) / max(now - since, WINDOW / 10)
