# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The messages of MCAP files, whether or not the files were finished. No ROS import.

A file is read with the library `mcap`, record by record up to its last whole one and without its
summary: the file of a recorder that was killed has none.

What a file may make its reader do is bounded: it may decompress to RATIO times its size and SLACK
bytes more, and its records are read one by one.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import IO, cast

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError, RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC as MAGIC

from loop_interfaces.files import FileError, open_ordinary, read_bounded
from loop_interfaces.text import shown
from recorder_node.bag import METADATA, BagError

RATIO, SLACK = 100, 64 * 2**20
"""A file of n bytes may decompress to RATIO n + SLACK bytes."""
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


def read(path: Path) -> Iterator[Message]:
    """The messages of a file in the order in which they were written. BagError if it is damaged."""
    types: dict[int, str] = {}
    channels: dict[int, Channel] = {}
    try:
        for record in _records(path):
            if isinstance(record, Schema):
                types[record.id] = _name(record.name)
            elif isinstance(record, Channel):
                _name(record.topic)
                channels[record.id] = record
            elif isinstance(record, McapMessage):
                if (channel := channels.get(record.channel_id)) is None:
                    raise ValueError(
                        f"a message of channel {record.channel_id}, which it does not declare"
                    )
                kind = types.get(channel.schema_id, "")
                yield Message(channel.topic, kind, record.log_time, record.data)
    except (McapError, ValueError) as error:
        text = f"{type(error).__name__} {error}" if isinstance(error, McapError) else error
        raise BagError(f"{path} cannot be read, as it is damaged: {text}") from error
    except OSError as error:
        raise BagError(f"{path} cannot be read: {error.strerror}") from error


def _name(text: str) -> str:
    """A topic's name or type, for printing. ValueError if it is not one."""
    if len(text) > MAX_NAME or not text.isprintable():
        raise ValueError(
            f"a topic's name or type is {text[:40]!r}; expected at most {MAX_NAME} characters that "
            "can be printed"
        )
    return text


def finished(path: Path) -> bool:
    """True if the recorder of the file at `path` finished, which repeats the magic bytes."""
    with open_ordinary(path) as file:
        file.seek(-min(len(MAGIC), path.stat().st_size), os.SEEK_END)
        return file.read() == MAGIC


def _records(path: Path) -> Iterator[McapRecord]:
    """The records of a file, including those in its chunks."""
    with open_ordinary(path) as file:
        size = os.fstat(file.fileno()).st_size
        left = RATIO * size + SLACK
        for record in _whole_records(file, size):
            if not isinstance(record, Chunk):
                yield record
                continue
            left -= record.uncompressed_size
            if left < 0:
                raise BagError(
                    f"{path} ({size} bytes) decompresses to more than {RATIO} times its size "
                    f"and {SLACK} bytes; expected less of a recording. If it is one, "
                    f"{_conversion(path.parent, 'convert')}"
                )
            yield from _in_chunk(_decompressed(record))


def _in_chunk(chunk: Chunk) -> Iterator[McapRecord]:
    """The records of a chunk, one by one: a small file may have millions."""
    get_chunk_data_stream(chunk, validate_crc=True)
    whole = _WholeReads(BytesIO(chunk.data), len(chunk.data))
    stream = ReadDataStream(cast("IO[bytes]", whole))
    while stream.count < len(chunk.data):
        opcode, size = stream.read1(), stream.read8()
        if opcode == Opcode.MESSAGE:
            yield McapMessage.read(stream, size)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            stream.read(size)


class _WholeReads:
    """A file of `size` bytes in which a read beyond the end is an error, and never a short one."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._left = file, size - file.tell()

    def read(self, length: int) -> bytes:
        if not 0 <= length <= self._left:
            raise EndOfFile
        self._left -= length
        return self._file.read(length)


def _whole_records(file: IO[bytes], size: int) -> Iterator[McapRecord]:
    """The records of a file up to its last whole one."""
    if file.read(len(MAGIC)) != MAGIC:
        raise ValueError("it is empty or not an MCAP file")
    stream = cast("IO[bytes]", _WholeReads(file, size))
    with contextlib.suppress(EndOfFile, RecordLengthLimitExceeded):
        yield from StreamReader(
            stream, skip_magic=True, emit_chunks=True, record_size_limit=size
        ).records


def _decompressed(chunk: Chunk) -> Chunk:
    """The same chunk, uncompressed: never more bytes than it says, whatever its data hold."""
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
    return replace(chunk, compression="", data=data)


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
