"""An MCAP file that grows by whole chunks, compressed with zstd. No ROS import.

It is made of the records of the library `mcap`, but not by its `Writer`: that takes three times as
long for a message, of which a fast loop sends 60,000 a second, and it cannot take back a chunk that
does not fit on the disk.

Source: https://mcap.dev/spec
"""

from __future__ import annotations

import io
import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC as MAGIC

LEVEL = 1
"""Compression level of zstd: higher ones save 4 % more of a bag of fields in twice the time."""
_MESSAGE = struct.Struct("<BQHIQQ")
"""A message record up to its data: opcode, length, channel, sequence, log time, publish time."""
_MESSAGE_HEADER = 22
"""Bytes of a message record between its length and its data."""


class McapFile:
    """Writes a new MCAP file of the profile `ros2`.

    A message is in the file when its chunk was closed. OSError whenever the disk refuses; the part of
    a chunk that was written then is cut off, and the file ends with the chunk before.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)
        self._compressor = zstandard.ZstdCompressor(level=LEVEL)
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: Counter[int] = Counter()
        self._open_chunk()
        self._append(MAGIC + _bytes(Header("ros2", "pdeloop")))

    def add_schema(self, name: str, text: str, encoding: str = "ros2msg") -> int:
        """Declare a message type by its definition; returns its number."""
        schema = Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=text.encode())
        self._schemas.append(schema)
        self._append(_bytes(schema))
        return schema.id

    def add_channel(self, topic: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Declare a topic whose messages are of the type number `schema`; returns its number."""
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="cdr",
            metadata=dict(metadata),
            schema_id=schema,
        )
        self._channels.append(channel)
        self._append(_bytes(channel))
        return channel.id

    def add_message(self, channel: int, when: int, data: bytes) -> None:
        """Put a message into the open chunk; when: its log and publish time, ns since the epoch."""
        chunk = self._chunk
        self._times[channel].append((when, chunk.tell()))
        size = _MESSAGE_HEADER + len(data)
        chunk.write(_MESSAGE.pack(Opcode.MESSAGE, size, channel, 0, when, when))
        chunk.write(data)

    @property
    def pending(self) -> int:
        """Bytes in the open chunk."""
        return self._chunk.tell()

    def close_chunk(self) -> None:
        """Write the open chunk, if there is something in it, and begin the next."""
        if not self._times:
            return
        data, begin = self._chunk.getvalue(), self._file.tell()
        chunk = Chunk(
            compression="zstd",
            data=self._compressor.compress(data),
            message_start_time=min(when for times in self._times.values() for when, _ in times),
            message_end_time=max(when for times in self._times.values() for when, _ in times),
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        builder = RecordBuilder()
        chunk.write(builder)
        length, offsets = builder.count, {}
        for channel, times in self._times.items():
            offsets[channel] = begin + builder.count
            MessageIndex(channel_id=channel, records=times).write(builder)
        index = ChunkIndex(
            chunk_start_offset=begin,
            chunk_length=length,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
            message_start_time=chunk.message_start_time,
            message_end_time=chunk.message_end_time,
            message_index_offsets=offsets,
            message_index_length=builder.count - length,
        )
        self._append(builder.end())
        self._chunks.append(index)
        self._counts.update({channel: len(times) for channel, times in self._times.items()})
        self._open_chunk()

    def statistics(self) -> Statistics:
        """What is in the chunks that were closed."""
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Write a metadata record, behind what was written so far."""
        record = _bytes(Metadata(name=name, metadata=dict(content)))
        index = MetadataIndex(offset=self._file.tell(), length=len(record), name=name)
        self._append(record)
        self._metadata.append(index)

    def finish(self) -> None:
        """Write the summary and the footer, and close the file."""
        self._append(_bytes(DataEnd(data_section_crc=0)))
        records: Iterable[McapRecord] = (
            *self._schemas,
            *self._channels,
            self.statistics(),
            *self._chunks,
            *self._metadata,
        )
        summary = b"".join(map(_bytes, records))
        start = self._file.tell()
        footer = _bytes(Footer(summary_start=start, summary_offset_start=0, summary_crc=0))
        crc = zlib.crc32(summary + footer[:-4])
        self._append(summary + footer[:-4] + struct.pack("<I", crc) + MAGIC)
        self.close()

    def close(self) -> None:
        """Close the file as it is: without a footer if it was not finished."""
        self._file.close()

    def _open_chunk(self) -> None:
        self._chunk = io.BytesIO()
        self._times: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        """By channel: time and place in the chunk of each message."""

    def _append(self, data: bytes) -> None:
        """Write all of `data` or nothing."""
        begin, rest = self._file.tell(), memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            self._file.truncate(begin)
            raise


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())
