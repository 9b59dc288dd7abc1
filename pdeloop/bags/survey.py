# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A survey of a bag's files in one pass, and the comparison with its metadata.yaml."""

from __future__ import annotations

import hashlib
import struct
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from pdeloop.bags.mcap_messages import McapFile, Message, unreadable
from pdeloop.messages.arrays import Array
from pdeloop.messages.documents import parse_json, parse_yaml
from pdeloop.messages.files import FileError, read_bounded
from pdeloop.messages.text import shown
from pdeloop.messages.topics import TARGET
from recorder_node.bag import METADATA, BagError
from recorder_node.recording import CLOCK, PARAMETERS_TOPIC, source_of

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


MAX_BYTES, MAX_NODES = 20_000_000, 1_000_000
"""Limits of metadata.yaml, which has about 50 entries per topic and 10 per file."""
NAMED = 5
"""Topics whose counts differ and that are named; the others are only counted."""


@dataclass(frozen=True)
class Extent:
    """Number of messages, start and duration (ns); None if not given."""

    messages: int | None = None
    first: int | None = None
    duration: int | None = None


@dataclass(frozen=True)
class Metadata:
    """The part of a metadata.yaml that can be checked.

    files: the names of the bag's files, in its order; by_file: what is said of each of them; topics:
    number of messages by topic.
    """

    files: list[str]
    whole: Extent
    by_file: dict[str, Extent]
    topics: dict[str, int]


@dataclass
class Findings:
    """Missing parts of a bag, and contradictions to its metadata.yaml, in words."""

    missing: list[str] = field(default_factory=list)
    differences: list[str] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.missing or self.differences)


def read_metadata(folder: Path) -> Metadata | None:
    """The metadata of the bag in `folder`; None if it has none. BagError if it cannot be read."""
    path = folder / METADATA
    if not path.exists():
        return None
    try:
        content = parse_yaml(read_bounded(path, MAX_BYTES), MAX_NODES)
    except FileError as error:
        raise BagError(str(error)) from error
    except ValueError as error:
        raise BagError(f"{path} is not valid YAML: {error}") from error
    try:
        return _metadata(content["rosbag2_bagfile_information"])
    except (LookupError, TypeError, AttributeError, ValueError) as error:
        raise BagError(
            f"{path} is not what rosbag2 writes ({type(error).__name__}: {shown(str(error))}); "
            "expected rosbag2_bagfile_information with relative_file_paths and counts of messages"
        ) from error


def _metadata(told: Any) -> Metadata:
    topics: Counter[str] = Counter()
    for entry in told.get("topics_with_message_count") or []:
        count = _whole(entry["message_count"])
        if count is not None:
            topics[str(entry["topic_metadata"]["name"])] += count
    return Metadata(
        files=[_name(path) for path in told["relative_file_paths"] or []],
        whole=_extent(told),
        by_file={_name(entry["path"]): _extent(entry) for entry in told.get("files") or []},
        topics=dict(topics),
    )


def _name(path: object) -> str:
    """A file's name; older versions of rosbag2 write the bag's folder in front of it."""
    if not isinstance(path, str):
        raise ValueError(f"a path is {shown(path)}")
    return path.rpartition("/")[2]


def _extent(told: Any) -> Extent:
    first = (told.get("starting_time") or {}).get("nanoseconds_since_epoch")
    duration = (told.get("duration") or {}).get("nanoseconds")
    return Extent(_whole(told.get("message_count")), _whole(first), _whole(duration))


def _whole(value: object) -> int | None:
    if value is not None and type(value) is not int:
        raise ValueError(f"a number is {shown(value)}")
    return value


def check(folder: Path, told: Metadata, found: Survey) -> Findings:
    """Files of a bag that are missing or contradict its metadata."""
    findings, files = Findings(), {file.name: file for file in found.files}
    for name in dict.fromkeys(told.files):
        count = told.by_file.get(name, Extent()).messages
        many = "" if count is None else f", with {count} messages"
        if name not in files:
            findings.missing.append(f"the file {shown(name)[1:-1]}, which {METADATA} names{many}")
        else:
            file = files[name]
            if not file.file.finished:
                findings.missing.append(f"the end of {name}: it is cut off")
            own = told.by_file.get(name, Extent())
            _check_extent(name, file.messages, file.first, file.last, own, findings)
    for name, times in Counter(told.files).items():
        if times > 1:
            findings.differences.append(f"{METADATA} names {shown(name)[1:-1]} {times} times")
    for name in files:
        if name not in told.files:
            findings.differences.append(f"{name} is in {folder}, but {METADATA} does not name it")
    listed = [name for name in dict.fromkeys(told.files) if name in files]
    order = [name for name in files if name in listed]
    pairs = pairwise(files[name] for name in listed)
    # Files that overlap in time have no order.
    if any((later.last or 0) < (earlier.first or 0) for earlier, later in pairs):
        findings.differences.append(
            f"{METADATA} lists its files in the order {', '.join(listed[:NAMED])}, but their "
            f"messages are in the order {', '.join(order[:NAMED])}"
        )
    _check_whole(told, Survey([files[name] for name in listed]), findings)
    return findings


def repeated(found: Survey) -> list[str]:
    """Files that hold the same messages as another one, in words."""
    first: dict[bytes, str] = {}
    texts = []
    for file in found.files:
        if file.messages and (other := first.setdefault(file.digest, file.name)) != file.name:
            texts.append(f"{file.name} holds the same messages as {other}")
    return texts


def _check_whole(told: Metadata, found: Survey, findings: Findings) -> None:
    """All listed files that are there; where some are missing, their messages are named with them."""
    counts: Counter[str] = Counter()
    for (topic, _), count in found.counts.items():
        counts[topic] += count
    if not findings.missing and not findings.differences:
        total = counts.total()
        _check_extent("the bag", total, found.first, found.last, told.whole, findings)
    others = [
        (topic, told.topics.get(topic, 0), counts[topic])
        for topic in sorted({*told.topics, *counts})
        if told.topics.get(topic, 0) != counts[topic]
    ]
    if not others or not told.topics:
        return
    parts = [f"{count} of {said} of {shown(topic)[1:-1]}" for topic, said, count in others[:NAMED]]
    more = f" and of {len(others) - NAMED} more topics" if len(others) > NAMED else ""
    text = f"the numbers of messages differ from those in {METADATA}: {', '.join(parts)}{more}"
    lost = all(count < said for _, said, count in others)
    (findings.missing if lost else findings.differences).append(text)


def _check_extent(
    what: str, messages: int, first: int | None, last: int | None, told: Extent, findings: Findings
) -> None:
    if told.messages is not None and messages != told.messages:
        text = f"{what} has {messages} messages, but {METADATA} says {told.messages}"
        (findings.missing if messages < told.messages else findings.differences).append(text)
    elif messages and told.first is not None and told.duration is not None:
        assert first is not None and last is not None
        if (first, last - first) != (told.first, told.duration):
            findings.differences.append(
                f"the messages of {what} are from {first} to {last} ns, but {METADATA} says from "
                f"{told.first} to {told.first + told.duration} ns"
            )
