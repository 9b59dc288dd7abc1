# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The topics of the loop that are recorded, and what each of them is. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from pdeloop.messages.frames import ArrayCodec
from pdeloop.messages.topics import ARRAYS, MODEL_FAILED, Topic
from recorder_node.bag import Channel

ARRAY_TYPE = "std_msgs/msg/Float64MultiArray"
TEXT_TYPE = "std_msgs/msg/String"
_NAMES = sorted([*(topic.name for topic in ARRAYS), MODEL_FAILED], key=len, reverse=True)


@dataclass(frozen=True)
class Source:
    """A topic that is recorded: what it is in the bag, and its entry in pdeloop.messages.topics.

    array: None for a topic without arrays; namespace: that of its pair, '' for what belongs to no
    pair.
    """

    channel: Channel
    array: Topic | None = None
    namespace: str = ""

    @cached_property
    def codec(self) -> ArrayCodec:
        """Decodes its messages, if it has arrays."""
        assert self.array is not None
        return self.array.codec()


CLOCK = Source(Channel("/clock", "rosgraph_msgs/msg/Clock"))
"""Simulated time, one topic for all pairs."""
DIAGNOSTICS = Source(Channel("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"))
PARAMETERS_TOPIC = "/recorder/parameters"
"""Under this name, which nobody publishes, the recorder writes the nodes' parameters into the bag: they
are then in whatever becomes of it, a copy of its file or a converted bag."""
NOTES = Source(Channel(PARAMETERS_TOPIC, TEXT_TYPE, latched=True))
ROSOUT = Source(Channel("/rosout", "rcl_interfaces/msg/Log", latched=True, depth=1000))


def sources(namespace: str) -> list[Source]:
    """The topics of a pair in the absolute `namespace` ('/' or '/left')."""
    base = namespace.rstrip("/")
    found = [
        Source(Channel(f"{base}/{topic.name}", ARRAY_TYPE, topic.latched), topic, base or "/")
        for topic in ARRAYS
    ]
    return [*found, Source(Channel(f"{base}/{MODEL_FAILED}", TEXT_TYPE, True), None, base or "/")]


def source_of(name: str) -> Source | None:
    """The topic of a pair with this full `name`; None for any other topic.

    >>> found = source_of("/left/episode/cost")
    >>> found.namespace, found.array.name
    ('/left', 'episode/cost')
    >>> source_of("/clock") is None
    True
    """
    for topic in _NAMES:
        if name.endswith(f"/{topic}"):
            pair = sources(name.removesuffix(f"/{topic}") or "/")
            return next(source for source in pair if source.channel.topic == name)
    return None
