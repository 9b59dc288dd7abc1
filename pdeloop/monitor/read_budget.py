"""How many states and actions the monitor reads. Pure.

Every sample a reader gets is one more datagram for its writer to send, also one that the reader
throws away. A loop makes thousands of rounds a second and a person sees a few pictures; so the
monitor reads whole episodes and has no reader in between. A slow loop is read all the time.
"""

from __future__ import annotations

from dataclasses import dataclass

MESSAGE = 4096
"""Bytes that count as one more message: a large one is several datagrams."""


@dataclass
class ReadBudget:
    """A budget of messages: read ones make a debt, time pays it back.

    budget: messages a second; burst: debt up to which there is no reason to stop; most: debt at
    which reading stops in the middle of an episode. `now` is any monotonic time in s.
    """

    budget: float = 1000.0
    burst: float = 300.0
    most: float = 4000.0
    listening: bool = False
    _debt: float = 0.0
    _paid: float | None = None

    def took(self, count: int, size: int = 0) -> None:
        """Note `count` messages of together `size` bytes."""
        self._debt += count + size / MESSAGE

    def decide(self, now: float, *, watched: bool, complete: bool) -> bool:
        """Whether to read on.

        watched: somebody looks at the page; complete: a whole episode was read.
        """
        elapsed = 0.0 if self._paid is None else max(0.0, now - self._paid)
        self._paid = now
        self._debt = max(0.0, self._debt - self.budget * elapsed)
        if not watched:
            self.listening = False
        elif self.listening:
            over = self._debt > (self.burst if complete else self.most)
            self.listening = not over
        else:
            self.listening = self._debt == 0.0
        return self.listening
