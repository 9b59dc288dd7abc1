"""What is published when a bag is played, on which topics, and when. Pure.

The messages are the recorded bytes, on topics of the recorded names, types and quality of service.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader, ReaderError

from loop_interfaces.topics import ARRAYS, MODEL_FAILED, RECORDER_STATUS
from pdeloop.bags.reader import Bag, Message
from recorder_node.bag import BagError

LATCHED = (*(topic.name for topic in ARRAYS if topic.latched), MODEL_FAILED, RECORDER_STATUS)


@dataclass(frozen=True)
class Channel:
    """A topic of a bag: full name, type, and the quality of service that its publisher offered."""

    topic: str
    type: str
    reliable: bool = True
    latched: bool = False
    depth: int = 1


def channels(bag: Bag) -> list[Channel]:
    """The topics of `bag`; of one that was not finished with the loop's own quality of service."""
    found: dict[str, Channel] = {}
    for part in bag.parts:
        if (part / "metadata.yaml").exists():
            found |= {channel.topic: channel for channel in _finished(part)}
        else:
            for message in Bag(part).messages():
                if message.topic not in found:
                    latched = message.topic.endswith(tuple(f"/{name}" for name in LATCHED))
                    found[message.topic] = Channel(message.topic, message.type, latched=latched)
    return [found[topic] for topic in sorted(found)]


def _finished(part: Any) -> list[Channel]:
    found = []
    try:
        with Reader(part) as reader:
            for connection in reader.connections:
                # One topic may have had several publishers; the strictest offer serves every reader.
                offers = getattr(connection.ext, "offered_qos_profiles", [])
                found.append(
                    Channel(
                        connection.topic,
                        connection.msgtype,
                        any(o.reliability != QosReliability.BEST_EFFORT for o in offers)
                        or not offers,
                        any(o.durability == QosDurability.TRANSIENT_LOCAL for o in offers),
                        max([1, *(o.depth for o in offers)]),
                    )
                )
    except (ReaderError, OSError, KeyError, TypeError, struct.error) as error:
        raise BagError(f"{part} cannot be read: {error}") from error
    return found


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
