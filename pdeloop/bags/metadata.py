# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Compares a bag's metadata.yaml with its files."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from pdeloop.bags.survey import FileSurvey, Survey
from pdeloop.messages.documents import parse_yaml
from pdeloop.messages.files import FileError, read_bounded
from pdeloop.messages.text import shown
from recorder_node.bag import METADATA, BagError

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
            _check_file(files[name], told.by_file.get(name, Extent()), findings)
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


def _check_file(file: FileSurvey, told: Extent, findings: Findings) -> None:
    """Compare one file with its description."""
    if not file.file.finished:
        findings.missing.append(f"the end of {file.name}: it is cut off")
    _check_extent(file.name, file.messages, file.first, file.last, told, findings)


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
