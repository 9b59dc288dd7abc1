# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The messages of MCAP files, in any order and whether or not the files were finished. No ROS import.

A file is read record by record up to its last whole one, without its summary: the file of a recorder
that was killed has none. What is damaged is named, and the rest is read: after the first damage only
chunks with a checksum.

What a file may make its reader do is bounded: it may decompress to RATIO times its size and SLACK
bytes more, its records are read one by one, and chunks of one time that are held together have at most
TOGETHER bytes.
"""

from __future__ import annotations

import heapq
import os
import re
import shlex
import struct
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import IO, cast

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC as MAGIC

from pdeloop.messages.files import FileError, open_ordinary, read_bounded
from pdeloop.messages.text import shown
from recorder_node.bag import METADATA, BagError

RATIO, SLACK = 100, 64 * 2**20
"""A file of n bytes may decompress to RATIO n + SLACK bytes."""
TOGETHER = 2**29
"""Bytes of chunks that may be held to read messages by their times."""
SEGMENT = 2**20
"""Bytes of messages outside of chunks that are read together."""
_HEAD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
"""Opcode and length of a record; channel, sequence and the two times at the head of a message."""
_READ = (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
MAX_TEXT = 100_000_000
"""Bytes of a text next to the bag."""
CONVERTED = "-mcap"
"""Suffix of the name of a bag that was converted as we advise."""
MAX_NAME = 256
"""Characters of a topic's name or type, which ROS and DDS allow."""


@dataclass(frozen=True)
class Message:
    """One recorded message: full topic name, type, time of arrival (ns), serialised bytes."""

    topic: str
    type: str
    when: int
    data: bytes


@dataclass(frozen=True)
class Segment:
    """A chunk, or messages outside of chunks that follow each other.

    place, size: its bytes in the file; held: those of its records; count, first: its messages, and
    the earliest time of them (ns).
    """

    place: int
    size: int
    held: int
    is_chunk: bool
    count: int
    first: int

    def joined(self, other: Segment) -> Segment | None:
        """One with the messages that follow these; None if there is a reason for two."""
        size = self.size + other.size
        together = self.place + self.size == other.place and size <= SEGMENT
        if self.is_chunk or other.is_chunk or not together:
            return None
        count, first = self.count + other.count, min(self.first, other.first)
        return replace(self, size=size, held=size, count=count, first=first)


class McapFile:
    """A file, which `messages` looks through once.

    segments: where its messages are; damage: what of it cannot be read, in words; finished: whether its
    recorder came to its end.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.segments: list[Segment] = []
        self.damage: list[str] = []
        self.finished = False
        self._types: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}

    def messages(self) -> Iterator[Message]:
        """The messages in the order in which they were written; what cannot be read is in `damage`.

        BagError for a file that cannot be opened, or decompresses to too much.
        """
        try:
            with open_ordinary(self.path) as file:
                yield from self._look_through(file, os.fstat(file.fileno()).st_size)
        except OSError as error:
            raise BagError(f"{self.path} cannot be read: {error.strerror}") from error

    def _look_through(self, file: IO[bytes], size: int) -> Iterator[Message]:
        if file.read(len(MAGIC)) != MAGIC:
            self.damage.append("it is empty or not an MCAP file")
            return
        place, left = len(MAGIC), RATIO * size + SLACK
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            opcode, length = _HEAD.unpack(head)
            end = place + _HEAD.size + length
            if opcode == 0 or end > size:
                if opcode == 0 or _ends_as_finished(file, size):
                    what = "zeros instead of a record" if opcode == 0 else "a record without an end"
                    self.damage.append(f"{what} at byte {place} of {size}")
                return
            if opcode in _READ and not (self.damage and opcode == Opcode.MESSAGE):
                content, count, first = file.read(length), 0, 0
                try:
                    if opcode == Opcode.CHUNK:
                        chunk = Chunk.read(_stream(content))
                        left -= chunk.uncompressed_size
                        if left < 0:
                            raise _too_large(self.path, size)
                        if self.damage and not chunk.uncompressed_crc:
                            raise ValueError("it has no checksum, and comes after another damage")
                        content = _decompressed(chunk)
                    else:
                        content = head + content
                    for inner, part in _records(content):
                        for message in self._declared(inner, part):
                            first = min(first, message.when) if count else message.when
                            count += 1
                            yield message
                except (McapError, ValueError) as error:
                    kind = f"{type(error).__name__} " if isinstance(error, McapError) else ""
                    what = "the chunk" if opcode == Opcode.CHUNK else "the record"
                    self.damage.append(f"{what} at byte {place}: {kind}{error}")
                if count:
                    is_chunk, held = opcode == Opcode.CHUNK, len(content)
                    self._keep(Segment(place, end - place, held, is_chunk, count, first))
            file.seek(end)
            place = end
            if opcode == Opcode.FOOTER:
                self.finished = file.read(len(MAGIC)) == MAGIC
                if self.finished and file.tell() < size:
                    self.damage.append(f"{size - file.tell()} bytes after its end")
                return

    def _keep(self, segment: Segment) -> None:
        joined = self.segments[-1].joined(segment) if self.segments else None
        self.segments[-1 if joined else len(self.segments) :] = [joined or segment]

    def _declared(self, opcode: int, content: bytes) -> Iterator[Message]:
        """The message that a record holds, if it is one; a schema or channel is noted."""
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(_stream(content))
            self._types[schema.id] = _name(schema.name)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(content))
            _name(channel.topic)
            self._channels[channel.id] = channel
        elif opcode == Opcode.MESSAGE:
            yield self._message(content)

    def _message(self, content: bytes) -> Message:
        if len(content) < _MESSAGE.size:
            raise EndOfFile
        number, _, when, _ = _MESSAGE.unpack_from(content)
        if (channel := self._channels.get(number)) is None:
            raise ValueError(f"a message of channel {number}, which it does not declare")
        kind = self._types.get(channel.schema_id, "")
        return Message(channel.topic, kind, when, content[_MESSAGE.size :])

    def of(self, segment: Segment) -> Iterator[Message]:
        """The messages of a segment by their times, once the file was looked through."""
        with open_ordinary(self.path) as file:
            file.seek(segment.place)
            content = file.read(segment.size)
        if segment.is_chunk:
            content = _decompressed(Chunk.read(_stream(content[_HEAD.size :])))
        places = [
            (_MESSAGE.unpack_from(content, place)[2], place, size)
            for opcode, place, size in islice(_places(content, Opcode.MESSAGE), segment.count)
        ]
        for _, place, size in sorted(places, key=itemgetter(0)):
            yield self._message(content[place : place + size])


def in_time(files: Sequence[McapFile]) -> Iterator[Message]:
    """The messages of files that were looked through, by their times (log_time).

    Those of one time are in the order in which they lie in the files. BagError where too much that is
    together in time lies apart in the files.
    """
    waiting = deque(
        sorted(
            ((n, segment) for n, file in enumerate(files) for segment in file.segments),
            key=lambda one: (one[1].first, one[0], one[1].place),
        )
    )
    begun: list[tuple[int, int, int, Message, Iterator[Message], int]] = []
    held = 0
    while waiting or begun:
        if waiting and (not begun or waiting[0][1].first <= begun[0][0]):
            n, segment = waiting.popleft()
            held += segment.held
            if held > TOGETHER and begun:
                raise BagError(
                    f"the messages of {files[n].path} are too far from the order of their times; "
                    "sort them: mcap sort FILE --output-file SORTED (https://mcap.dev/guides/cli)"
                )
            messages = files[n].of(segment)
            if (first := next(messages, None)) is not None:
                entry = (first.when, n, segment.place, first, messages, segment.held)
                heapq.heappush(begun, entry)
            continue
        _, n, place, message, messages, size = begun[0]
        yield message
        if (following := next(messages, None)) is None:
            heapq.heappop(begun)
            held -= size
        else:
            heapq.heapreplace(begun, (following.when, n, place, following, messages, size))


def read(path: Path) -> Iterator[Message]:
    """The messages of a file in the order in which they were written. BagError if it is damaged."""
    file = McapFile(path)
    yield from file.messages()
    if file.damage:
        raise unreadable(file)


def _too_large(path: Path, size: int) -> BagError:
    return BagError(
        f"{path} ({size} bytes) decompresses to more than {RATIO} times its size and {SLACK} bytes; "
        f"expected less of a recording. If it is one, {_conversion(path.parent, 'convert')}"
    )


def unreadable(file: McapFile) -> BagError:
    """The error for a file of which nothing can be read."""
    return BagError(f"{file.path} cannot be read, as it is damaged: {file.damage[0]}")


def _name(text: str) -> str:
    """A topic's name or type, for printing. ValueError if it is not one."""
    if len(text) > MAX_NAME or not text.isprintable():
        raise ValueError(
            f"a topic's name or type is {text[:40]!r}; expected at most {MAX_NAME} characters that "
            "can be printed"
        )
    return text


def _ends_as_finished(file: IO[bytes], size: int) -> bool:
    """True if a file ends with the magic bytes, as one does whose recorder finished."""
    file.seek(size - min(len(MAGIC), size))
    return file.read() == MAGIC


def _places(content: bytes, *wanted: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, place and size of the contents of wanted records. EndOfFile if the last is cut off."""
    place = 0
    while place < len(content):
        if place + _HEAD.size > len(content):
            raise EndOfFile
        opcode, size = _HEAD.unpack_from(content, place)
        place += _HEAD.size
        if size > len(content) - place:
            raise EndOfFile
        if opcode in wanted:
            yield opcode, place, size
        place += size


def _records(content: bytes) -> Iterator[tuple[int, bytes]]:
    """The records of a chunk that are read, one by one: a small file may have millions."""
    for opcode, place, size in _places(content, Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA):
        yield opcode, content[place : place + size]


class _WholeReads:
    """Bytes in which a read beyond the end is an error, and never a short one."""

    def __init__(self, content: bytes) -> None:
        self._file, self._left = BytesIO(content), len(content)

    def read(self, length: int) -> bytes:
        if not 0 <= length <= self._left:
            raise EndOfFile
        self._left -= length
        return self._file.read(length)


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(cast("IO[bytes]", _WholeReads(content)))


def _decompressed(chunk: Chunk) -> bytes:
    """The records of a chunk, whose checksum is right: never more bytes than it says."""
    size, data = chunk.uncompressed_size, chunk.data
    try:
        if chunk.compression == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(data) as reader:
                data = reader.read(size + 1)
        elif chunk.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif chunk.compression:
            raise ValueError(
                f"chunks compressed by {shown(chunk.compression)}; expected zstd, lz4 or none"
            )
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise ValueError(str(error)) from error
    if len(data) != size:
        raise ValueError("the content of a chunk does not have the declared size")
    get_chunk_data_stream(replace(chunk, compression="", data=data), validate_crc=True)
    return data


def files(folder: Path) -> list[Path]:
    """The MCAP files of a bag in their order. BagError, saying what to do, for one of another kind."""
    by_message = re.search(
        r"compression_mode:\W*message", text_of(folder / METADATA), re.IGNORECASE
    )
    for kind, found in (
        ("a sqlite3 bag", any(folder.glob("*.db3*"))),
        ("compressed by rosbag2", by_message or any(folder.glob("*.zstd"))),
    ):
        if found:
            raise BagError(
                f"{folder} is {kind}; expected MCAP (with compressed chunks, if any). "
                f"{_conversion(folder)}"
            )
    return sorted(folder.glob("*.mcap"), key=lambda path: (len(path.name), path.name))


def _conversion(folder: Path, begin: str = "Convert") -> str:
    """The command that converts the bag in `folder` to one that can be read."""
    src, dst = (shlex.quote(str(path)) for path in (folder, f"{folder}{CONVERTED}"))
    return f"{begin} it: rosbags-convert --src {src} --dst {dst} --dst-storage mcap"


def text_of(path: Path) -> str:
    """The content of a text file next to a bag; empty if there is none."""
    try:
        return read_bounded(path, MAX_TEXT).decode(errors="replace") if path.exists() else ""
    except FileError as error:
        raise BagError(str(error)) from error
