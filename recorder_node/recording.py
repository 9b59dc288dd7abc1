# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A recording: the loop's messages in one bag, and the topics that are recorded. No ROS.

bag/bag.mcap, bag/metadata.yaml    the bag
bag/parameters.json                the parameters, by run, of the nodes that have answered; the
                                   same stands in the bag, under PARAMETERS_TOPIC
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pdeloop.messages.files import writing_to
from pdeloop.messages.frames import ArrayCodec, FrameError
from pdeloop.messages.topics import ARRAYS, MODEL_FAILED, START, STATE, Topic
from recorder_node.bag import BagError, BagWriter, Channel

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


PARAMETERS = "parameters.json"
CDR = bytes.fromhex("00010000")
"""The first bytes of a serialised message: CDR, little endian."""
LARGE_BAG = 2**30
"""Bytes of states that a run is told of before they are recorded."""
EVERY = "state_every"
"""The recorder's parameter that stands among those of the nodes, where it is not 1."""


def large_bag(values: Mapping[str, Any], every: int = 1) -> str:
    """A sentence where the states of a run with these parameters take much room; else nothing.

    >>> large_bag({"n_z": 65536, "horizon": 100, "rollouts": 20, "evaluation_fields": 5})
    'the states of this run take about 1.9 GB in its bag: --record-every N (state_every) keeps fewer'
    >>> large_bag({"n_z": 128, "horizon": 300, "rollouts": 20})
    ''
    """
    known = {"n_z": 0, "horizon": 0, "rollouts": 0, "evaluation_fields": 0, "seeds": 1, **values}
    rollouts = known["seeds"] * (known["rollouts"] + 3 * known["evaluation_fields"])
    size = 8 * known["n_z"] * rollouts * -(-(known["horizon"] + 1) // every)
    if size < LARGE_BAG:
        return ""
    return (
        f"the states of this run take about {size / 1e9:.1f} GB in its bag; to record fewer of "
        f"them: --record-every N ({EVERY})"
    )


class Recording(BagWriter):
    """A bag of the messages that `take` is given, with the nodes' parameters next to it.

    state_every: steps from one state that is recorded to the next.
    """

    def __init__(self, path: Path, what: Sequence[Source], state_every: int = 1) -> None:
        super().__init__(path, [source.channel for source in (*what, NOTES)])
        self._every = state_every
        self.run = 0
        """The run of the newest episode; 0 before the first."""
        self._notes: dict[str, Any] = {}

    def take(self, source: Source, when: int, raw: bytes) -> None:
        """Record one message that arrived at `when` (ns since the epoch)."""
        if source.array is START:
            with contextlib.suppress(FrameError):
                self.run = source.codec.decode(raw).run
        if source.array is STATE and self._every > 1:
            with contextlib.suppress(FrameError):
                if source.codec.decode(raw).step % self._every:
                    return
        self.write(source.channel.topic, when, raw)

    def note(self, run: int, parameters: Mapping[str, Any]) -> None:
        """Add to the known parameters of a run."""
        own = {EVERY: self._every} if self._every > 1 else {}
        self._notes[str(run)] = self._notes.get(str(run), {}) | dict(parameters) | own
        text = json.dumps({str(run): self._notes[str(run)]}).encode() + b"\0"
        when = self._last if self.messages else time.time_ns()
        self.write(PARAMETERS_TOPIC, when, CDR + len(text).to_bytes(4, "little") + text)
        with writing_to(f"to {self.path}", BagError):
            part = self.path / f"{PARAMETERS}.part"  # not synchronised, as that could take long
            part.write_text(json.dumps(self._notes, indent=1))
            part.replace(self.path / PARAMETERS)
