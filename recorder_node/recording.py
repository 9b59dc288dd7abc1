# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A recording: the loop's messages in one bag. No ROS.

bag/bag.mcap, bag/metadata.yaml    the bag
bag/parameters.json                the parameters, by run, of the nodes that have answered; the
                                   same stands in the bag, under PARAMETERS_TOPIC
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from loop_interfaces.frames import FrameError
from loop_interfaces.topics import START
from recorder_node.bag import BagError, BagWriter
from recorder_node.sources import NOTES, PARAMETERS_TOPIC, Source

PARAMETERS = "parameters.json"
CDR = bytes.fromhex("00010000")
"""How the serialisation of a message begins: CDR, little endian."""


class Recording(BagWriter):
    """A bag of the messages that `take` is given, with the nodes' parameters next to it."""

    def __init__(self, path: Path, what: Sequence[Source]) -> None:
        super().__init__(path, [source.channel for source in (*what, NOTES)])
        self.run = 0
        """The run of the newest episode; 0 before the first."""
        self._notes: dict[str, Any] = {}

    def take(self, source: Source, when: int, raw: bytes) -> None:
        """Record one message that arrived at `when` (ns since the epoch)."""
        if source.array is START:
            with contextlib.suppress(FrameError):
                self.run = source.codec.decode(raw).run
        self.write(source.channel.topic, when, raw)

    def note(self, run: int, parameters: Mapping[str, Any]) -> None:
        """Add to the known parameters of a run."""
        self._notes[str(run)] = self._notes.get(str(run), {}) | dict(parameters)
        text = json.dumps({str(run): self._notes[str(run)]}).encode() + b"\0"
        when = self._last if self.messages else time.time_ns()
        self.write(PARAMETERS_TOPIC, when, CDR + len(text).to_bytes(4, "little") + text)
        try:
            part = self.path / f"{PARAMETERS}.part"  # not synchronised, as that could take long
            part.write_text(json.dumps(self._notes, indent=1))
            part.replace(self.path / PARAMETERS)
        except OSError as error:
            raise BagError(f"cannot write to {self.path}: {error.strerror}") from error
