"""The messages of MCAP files, whether or not the files were finished. No ROS import.

A file is read record by record up to its last whole one, without its summary: that of a recorder
that was killed has none. Chunks outside the wanted time are skipped without being read.

What a file may make its reader do is bounded: it may decompress to RATIO times its size and SLACK
bytes more.
"""

from __future__ import annotations

import heapq
import io
import os
import re
import struct
import zlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import lz4.frame
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, Schema
from mcap.writer import MCAP0_MAGIC as MAGIC

from recorder_node.bag import HASH, METADATA, QOS, BagError, Channel, Definition

RATIO, SLACK = 100, 64 * 2**20
"""A file of n bytes may decompress to RATIO n + SLACK bytes."""
MAX_TEXT = 100_000_000
"""Bytes that are read of a text beside the bag."""
_RECORD = struct.Struct("<BQ")
"""Opcode and length of a record."""
_MESSAGE = struct.Struct("<HIQQ")
"""What stands before the data of a message: channel, sequence, log time, publish time."""
_CHUNK_TIMES = struct.Struct("<QQ")
"""What a chunk begins with: the times of its first and its last message."""
_NO_SCHEMA = Schema(id=0, name="", encoding="", data=b"")
_DAMAGED = (McapError, struct.error, ValueError, KeyError)
"""What the library raises for records that are none."""


@dataclass(frozen=True)
class Message:
    """One recorded message: full topic name, type, time of arrival (ns), serialised bytes."""

    topic: str
    type: str
    when: int
    data: bytes


@dataclass(frozen=True)
class _Record:
    """Where the content of a record is, and of a chunk the times of its messages (ns)."""

    opcode: int
    start: int
    length: int
    first: int = 0
    last: int = 0


class McapMessages:
    """The messages of the MCAP file at `path`.

    channels: its topics by their numbers; finished: whether its recorder came to its end. Raises
    BagError for a file that is none or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._chunks: list[_Record] = []
        """And messages outside chunks."""
        self._read = 0
        """Bytes that were decompressed."""
        try:
            with path.open("rb") as file:
                self._size = os.fstat(file.fileno()).st_size
                self.finished = self._scan(file)
        except _DAMAGED as error:
            raise self._damaged(error) from error
        except OSError as error:
            raise BagError(f"{path} cannot be read: {error.strerror}") from error

    def messages(self, start: int | None, stop: int | None) -> Iterator[Message]:
        """Those in [start, stop) ns in the order of their times."""
        low, high = start or 0, 2**64 if stop is None else stop
        self._read = 0
        pending: list[tuple[int, int, int, bytes]] = []
        count = 0
        try:
            with self._path.open("rb") as file:
                for chunk in sorted(self._chunks, key=lambda record: record.first):
                    if chunk.last < low or chunk.first >= high:
                        continue
                    while pending and pending[0][0] < chunk.first:
                        yield self._message(heapq.heappop(pending))
                    for channel, when, data in self._content(file, chunk):
                        if low <= when < high:
                            heapq.heappush(pending, (when, count, channel, data))
                            count += 1
            while pending:
                yield self._message(heapq.heappop(pending))
        except _DAMAGED as error:
            raise self._damaged(error) from error
        except OSError as error:
            raise BagError(f"{self._path} cannot be read: {error.strerror}") from error

    def _message(self, found: tuple[int, int, int, bytes]) -> Message:
        when, _, number, data = found
        channel = self.channels[number]
        return Message(channel.topic, channel.type, when, data)

    def _scan(self, file: IO[bytes]) -> bool:
        """Find the topics and the chunks; whether the file has an end."""
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("it is empty or no MCAP file")
        finished = False
        for opcode, start, length in _records(file, self._size):
            if opcode == Opcode.CHUNK:
                times = _CHUNK_TIMES.unpack(file.read(_CHUNK_TIMES.size))
                self._chunks.append(_Record(opcode, start, length, *times))
            elif opcode == Opcode.MESSAGE:
                when = _MESSAGE.unpack(file.read(_MESSAGE.size))[2]
                self._chunks.append(_Record(opcode, start, length, when, when))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._declare(opcode, file.read(length))
            finished = opcode == Opcode.FOOTER
        if not self.channels:  # an unfinished file of a writer that declares them within chunks
            for record in self._chunks:
                deque(self._content(file, record), maxlen=0)
        return finished

    def _declare(self, opcode: int, content: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(_stream(content))
            self._schemas[schema.id] = schema
            return
        found = McapChannel.read(_stream(content))
        schema = self._schemas.get(found.schema_id, _NO_SCHEMA)
        text = schema.data.decode()
        known = Definition(text, schema.encoding, found.metadata.get(HASH, ""))
        self.channels[found.id] = _channel(found, schema.name, known)

    def _content(self, file: IO[bytes], record: _Record) -> Iterator[tuple[int, int, bytes]]:
        """Channel, time and bytes of the messages of a chunk, or of one outside chunks."""
        file.seek(record.start)
        raw = file.read(record.length)
        if record.opcode == Opcode.MESSAGE:
            yield self._numbers(raw)
            return
        content = self._decompressed(Chunk.read(_stream(raw)))
        inner = io.BytesIO(content)
        for opcode, _, length in _records(inner, len(content)):
            if opcode == Opcode.MESSAGE:
                yield self._numbers(inner.read(length))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._declare(opcode, inner.read(length))
            else:
                raise ValueError(f"a chunk holds a record of kind {opcode}")

    def _numbers(self, record: bytes) -> tuple[int, int, bytes]:
        channel, _, when, _ = _MESSAGE.unpack_from(record)
        if channel not in self.channels:
            raise ValueError(f"a message of channel {channel}, which it does not declare")
        return channel, when, record[_MESSAGE.size :]

    def _decompressed(self, chunk: Chunk) -> bytes:
        size = chunk.uncompressed_size
        self._read += size
        if self._read > RATIO * self._size + SLACK:
            raise BagError(
                f"{self._path} ({self._size} bytes) decompresses to more than {RATIO} times its size "
                f"and {SLACK} bytes; expected less of a recording. If it is one, convert it to an "
                "uncompressed bag (ros2 bag convert)"
            )
        data = _decompress(chunk.compression, chunk.data, size)
        if len(data) != size or (
            chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc
        ):
            raise ValueError("the content of a chunk is not that of its checksum")
        return data

    def _damaged(self, error: Exception) -> BagError:
        text = f"{type(error).__name__} {error}" if type(error) is not ValueError else str(error)
        return BagError(f"{self._path} cannot be read, it is damaged: {text}")


def _records(file: IO[bytes], size: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, place of the content and length of each whole record from here up to `size`.

    The file stands at the content then, and may be read from.
    """
    position = file.tell()
    while len(head := file.read(_RECORD.size)) == _RECORD.size:
        opcode, length = _RECORD.unpack(head)
        start = position + _RECORD.size
        position = start + length
        if position > size:
            return  # the end of what was written
        yield opcode, start, length
        file.seek(position)


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


def _decompress(compression: str, data: bytes, size: int) -> bytes:
    """At most size + 1 bytes, whatever the data say of themselves."""
    if compression == "zstd":
        try:
            with zstandard.ZstdDecompressor().stream_reader(data) as reader:
                return bytes(reader.read(size + 1))
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
    if compression == "lz4":
        try:
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
        except (RuntimeError, EOFError) as error:
            raise ValueError(str(error)) from error
    if compression:
        raise ValueError(f"chunks compressed by {compression!r}; expected zstd, lz4 or none")
    return data


def _channel(found: McapChannel, kind: str, known: Definition) -> Channel:
    """A topic with what its publishers offered; the strictest offer serves every reader."""
    offers = _offers(found.metadata.get(QOS, ""))

    def any_offers(name: str, *values: object) -> bool:
        return any(offer.get(name) in values for offer in offers)

    return Channel(
        found.topic,
        kind,
        # As numbers in bags of ROS 2 before Jazzy (rmw_qos_*_policy_t).
        latched=any_offers("durability", "transient_local", 1),
        reliable=any_offers("reliability", "reliable", 1) or not offers,
        depth=max((offer["depth"] for offer in offers), default=1),
        definition=known,
    )


@lru_cache
def _offers(text: str) -> list[dict[str, Any]]:
    """The offered quality of service of a topic's publishers; empty if it is not told."""
    try:
        offers = [dict(offer) for offer in yaml.safe_load(text) or []]
        return [{**offer, "depth": max(1, int(offer.get("depth", 1)))} for offer in offers]
    except (yaml.YAMLError, TypeError, ValueError, RecursionError):
        return []


def files(folder: Path) -> list[Path]:
    """The MCAP files of a bag in their order. BagError, saying what to do, for one of another kind."""
    for kind, found in (
        ("a sqlite3 bag", any(folder.glob("*.db3*"))),
        ("compressed by rosbag2", any(folder.glob("*.zstd")) or _compressed_messages(folder)),
    ):
        if found:
            raise BagError(
                f"{folder} is {kind}; expected MCAP (with compressed chunks, if any). Convert it: "
                f"rosbags-convert --src {folder} --dst {folder}-mcap --dst-storage mcap"
            )
    return sorted(folder.glob("*.mcap"), key=lambda path: (len(path.name), path.name))


def _compressed_messages(folder: Path) -> bool:
    try:
        with (folder / METADATA).open("rb") as file:
            text = file.read(MAX_TEXT).decode(errors="replace")
    except OSError:
        return False
    return re.search(r"compression_mode:\W*message", text, re.IGNORECASE) is not None
