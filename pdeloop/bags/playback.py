"""When each message of a bag is published when it is played. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from pdeloop.bags.mcap_messages import Message
from pdeloop.bags.reader import Bag
from recorder_node.bag import BagError


class Playback:
    """The messages of a bag by the wall clock: what was recorded s seconds after the first message
    is due s / rate seconds after the beginning.

    again: begin anew at the end, for ever. `now` is any monotonic time in s.
    """

    def __init__(self, bag: Bag, *, rate: float, again: bool) -> None:
        self._bag, self._rate, self._again = bag, rate, again
        self.published = 0
        self.over = False
        self._messages: Iterator[Message] = iter(())
        self._next: Message | None = None
        self._first = 0
        self._begun = 0.0

    def begin(self, now: float) -> None:
        """The first message is due now. BagError if there is none."""
        self._messages = self._bag.messages()
        self._next = next(self._messages, None)
        if self._next is None:
            raise BagError(f"{self._bag.path} holds no messages")
        self._first, self._begun = self._next.when, now

    def delay(self, seconds: float) -> None:
        """Nobody could publish for `seconds`: everything is due so much later."""
        self._begun += seconds

    @property
    def due(self) -> float | None:
        """When the next message is due; None if there is none left."""
        if self._next is None:
            return None
        return self._begun + (self._next.when - self._first) / 1e9 / self._rate

    def take(self, now: float) -> Iterator[Message]:
        """The messages that are due, in the order of their arrival at the recorder."""
        while (due := self.due) is not None and due <= now:
            assert self._next is not None
            yield self._next
            self.published += 1
            self._next = next(self._messages, None)
            if self._next is None and self._again:
                self.begin(now)
                return
        self.over = self._next is None
