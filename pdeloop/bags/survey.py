# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A survey of a bag's files in one pass: counts, times, parameters, the target."""

from __future__ import annotations

import hashlib
import struct
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from pdeloop.bags.mcap_messages import McapFile, Message, unreadable
from pdeloop.messages.arrays import Array
from pdeloop.messages.documents import parse_json
from pdeloop.messages.topics import TARGET
from recorder_node.bag import BagError
from recorder_node.sources import CLOCK, PARAMETERS_TOPIC, source_of

MAX_PARAMETERS = 10_000_000
"""Bytes of a message with parameters."""


@dataclass
class FileSurvey:
    """One file: messages by topic and type, the first and the last time (ns), a digest of all of it."""

    file: McapFile
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    first: int | None = None
    last: int | None = None
    digest: bytes = b""

    @property
    def name(self) -> str:
        return self.file.path.name

    @property
    def messages(self) -> int:
        return self.counts.total()


@dataclass
class Survey:
    """All files of a bag.

    parameters: those of the nodes, by run, where the files have them; target: z_r, None if
    there is none; clock: the times on /clock (ns).
    """

    files: list[FileSurvey] = field(default_factory=list)
    parameters: dict[int, dict[str, Any]] = field(default_factory=dict)
    target: Array | None = None
    clock: array[int] = field(default_factory=lambda: array("q"))

    @property
    def counts(self) -> Counter[tuple[str, str]]:
        """Messages by topic and type."""
        return sum((file.counts for file in self.files), Counter[tuple[str, str]]())

    @property
    def first(self) -> int | None:
        return min((file.first for file in self.files if file.first is not None), default=None)

    @property
    def last(self) -> int | None:
        return max((file.last for file in self.files if file.last is not None), default=None)


def survey(files: Sequence[Path]) -> Survey:
    """Look through the files once; they come by the times of their first messages.

    BagError where nothing can be read because of damages.
    """
    found, known = Survey(), cache(source_of)
    noted: dict[int, int] = {}
    for path in files:
        file, digest = FileSurvey(McapFile(path)), hashlib.blake2b()
        for message in file.file.messages():
            file.counts[message.topic, message.type] += 1
            file.first = message.when if file.first is None else min(file.first, message.when)
            file.last = message.when if file.last is None else max(file.last, message.when)
            digest.update(message.data)
            if message.topic == PARAMETERS_TOPIC:
                _take_parameters(found.parameters, noted, message, path)
            if (message.topic, message.type) == (CLOCK.channel.topic, CLOCK.channel.type):
                found.clock.append(_clock_time(message.data))
            source = None if found.target is not None else known(message.topic)
            if source is not None and source.array is TARGET:
                found.target = source.codec.decode(message.data).values
        file.digest = digest.digest()
        found.files.append(file)
    damaged = [file.file for file in found.files if file.file.damage]
    if damaged and not found.counts:
        raise unreadable(damaged[0])
    found.files.sort(key=lambda file: file.first or 0)
    return found


def _clock_time(raw: bytes) -> int:
    """The time in a message on /clock, in ns; -1 for bytes that are none."""
    if len(raw) < 12:
        return -1
    seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] else ">iI", raw, 4)
    return int(seconds * 10**9 + nanoseconds)


def _take_parameters(
    known: dict[int, dict[str, Any]], noted: dict[int, int], message: Message, path: Path
) -> None:
    """Take the recorder's notes of a run's parameters; the latest note has all of them.

    noted: the times of the known ones (ns).
    """
    try:
        if len(message.data) > MAX_PARAMETERS:
            raise ValueError(f"they have more than {MAX_PARAMETERS} bytes")
        for run, values in by_run(parse_json(message.data[8:].rstrip(b"\0"))).items():
            if message.when >= noted.get(run, message.when):
                known[run], noted[run] = values, message.when
    except ValueError as error:
        raise BagError(f"the parameters in {path} cannot be read: {error}") from error


def by_run(content: object) -> dict[int, dict[str, Any]]:
    """The parameters by run that a JSON object holds. ValueError unless it is one."""
    try:
        assert isinstance(content, dict)
        return {int(run): dict(values) for run, values in content.items()}
    except (AssertionError, TypeError, ValueError) as error:
        raise ValueError("expected an object with an object of parameters for each run") from error
