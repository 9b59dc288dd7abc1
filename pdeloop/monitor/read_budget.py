"""How many states and actions the monitor reads. Pure.

Every sample is one more datagram for its writer, whether the reader uses it or not. A loop makes
thousands of rounds a second and a person sees a few pictures, so the monitor reads whole episodes and
has no reader in between. A slow loop is read all the time.
"""

from __future__ import annotations

from dataclasses import dataclass

MESSAGE = 4096
"""Bytes that count as one more message: a large one is several datagrams."""


@dataclass
class ReadBudget:
    """A leaky bucket of the messages that were read.

    Parameters
    ----------
    rate
        Messages that leave it in a second.
    burst, most
        Levels above which reading stops, after a whole episode and in the middle of one. It starts
        again when the bucket is empty.
    """

    rate: float = 1000.0
    burst: float = 300.0
    most: float = 4000.0
    listening: bool = False
    _level: float = 0.0
    _when: float | None = None

    def took(self, count: int, size: int = 0) -> None:
        """Add `count` messages of together `size` bytes."""
        self._level += count + size / MESSAGE

    def decide(self, now: float, *, page_open: bool, complete: bool) -> bool:
        """Whether to read on at time `now` (monotonic s).

        page_open: whether a page is open; complete: a whole episode was read.
        """
        elapsed = 0.0 if self._when is None else max(0.0, now - self._when)
        self._when = now
        self._level = max(0.0, self._level - self.rate * elapsed)
        limit = (self.burst if complete else self.most) if self.listening else 0.0
        self.listening = page_open and self._level <= limit
        return self.listening
