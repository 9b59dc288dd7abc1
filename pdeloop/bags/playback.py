"""When each message of a bag is published when it is played. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from pdeloop.bags.mcap_messages import Message
from pdeloop.bags.reader import Bag
from recorder_node.bag import BagError


class Playback:
    """The messages of a bag by the clock: what was recorded s seconds after the first message is due
    s / rate seconds after the first call of `take`.

    again: begin anew at the end, for ever.
    """

    def __init__(self, bag: Bag, *, rate: float, again: bool) -> None:
        self._bag, self._rate, self._again = bag, rate, again
        self.published = 0
        self.over = False
        self._messages: Iterator[Message] = iter(())
        self._next: Message | None = None
        self._first, self._begun = 0, 0.0

    def take(self, now: float) -> Iterator[Message]:
        """The messages that are due at time `now` (monotonic s), in the order of the bag.

        BagError if the bag holds none.
        """
        if self._next is None and not self.over:
            self._begin(now)
        while self._next is not None and self._due(self._next) <= now:
            yield self._next
            self.published += 1
            self._next = next(self._messages, None)
        self.over = self._next is None and not self._again

    def _due(self, message: Message) -> float:
        return self._begun + (message.when - self._first) / 1e9 / self._rate

    def _begin(self, now: float) -> None:
        self._messages = self._bag.messages()
        self._next = next(self._messages, None)
        if self._next is None:
            raise BagError(f"{self._bag.path} holds no messages")
        self._first, self._begun = self._next.when, now
