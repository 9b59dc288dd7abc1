"""The messages of MCAP files, whether or not the files were finished. No ROS import.

A file is read with the library `mcap`, record by record up to its last whole one and without its
summary: the file of a recorder that was killed has none. Chunks outside the wanted time are not
decompressed.

What a file may make its reader do is bounded: it may decompress to RATIO times its size and SLACK
bytes more.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, cast

import lz4.frame
import yaml
import zstandard
from mcap.exceptions import EndOfFile, McapError, RecordLengthLimitExceeded
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, Footer, McapRecord, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC as MAGIC

from recorder_node.bag import METADATA, QOS, BagError, Channel

RATIO, SLACK = 100, 64 * 2**20
"""A file of n bytes may decompress to RATIO n + SLACK bytes."""
MAX_TEXT = 100_000_000
"""Bytes that are read of a text beside the bag."""


@dataclass(frozen=True)
class Message:
    """One recorded message: full topic name, type, time of arrival (ns), serialised bytes."""

    topic: str
    type: str
    when: int
    data: bytes


class McapMessages:
    """The messages of the MCAP file at `path`.

    channels: its topics by their numbers; finished: whether its recorder came to its end. Raises
    BagError for a file that is none or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._types: dict[int, str] = {}
        self.channels: dict[int, Channel] = {}
        outside = self._records(lambda chunk: False)
        self.finished = any(isinstance(record, Footer) for record in outside)
        if not self.channels:  # an unfinished file declares them within its chunks alone
            for _ in self._records(lambda chunk: True):
                pass

    def messages(self, start: int | None = None, stop: int | None = None) -> Iterator[Message]:
        """Those in [start, stop) ns, in the order in which they were written."""
        low, high = start or 0, 2**64 if stop is None else stop
        for record in self._records(
            lambda chunk: chunk.message_end_time >= low and chunk.message_start_time < high
        ):
            if isinstance(record, McapMessage) and low <= record.log_time < high:
                channel = self.channels[record.channel_id]
                yield Message(channel.topic, channel.type, record.log_time, record.data)

    def _records(self, wanted: Callable[[Chunk], bool]) -> Iterator[McapRecord]:
        """The records outside chunks, and those in the chunks that are `wanted`."""
        try:
            with self._path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                left = RATIO * size + SLACK
                for record in _whole_records(file, size):
                    inner = [record]
                    if isinstance(record, Chunk):
                        if not wanted(record):
                            continue
                        left -= record.uncompressed_size
                        if left < 0:
                            raise self._too_large(size)
                        inner = breakup_chunk(_decompressed(record), validate_crc=True)
                    for one in inner:
                        self._note(one)
                        yield one
        except (McapError, ValueError) as error:
            text = f"{type(error).__name__} {error}" if isinstance(error, McapError) else error
            raise BagError(f"{self._path} cannot be read, it is damaged: {text}") from error
        except OSError as error:
            raise BagError(f"{self._path} cannot be read: {error.strerror}") from error

    def _note(self, record: McapRecord) -> None:
        """Keep what declares a topic; refuse a message of a topic that is not declared."""
        if isinstance(record, Schema):
            self._types[record.id] = record.name
        elif isinstance(record, McapChannel):
            kind = self._types.get(record.schema_id, "")
            self.channels[record.id] = _channel(record, kind)
        elif isinstance(record, McapMessage) and record.channel_id not in self.channels:
            raise ValueError(f"a message of channel {record.channel_id}, which it does not declare")

    def _too_large(self, size: int) -> BagError:
        return BagError(
            f"{self._path} ({size} bytes) decompresses to more than {RATIO} times its size "
            f"and {SLACK} bytes; expected less of a recording. If it is one, convert it to an "
            "uncompressed bag (ros2 bag convert)"
        )


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
        raise ValueError("it is empty or no MCAP file")
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
                f"chunks compressed by {chunk.compression!r}; expected zstd, lz4 or none"
            )
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise ValueError(str(error)) from error
    if len(data) != size:
        raise ValueError("the content of a chunk is not of the size that it says")
    return replace(chunk, compression="", data=data)


def _channel(found: McapChannel, kind: str) -> Channel:
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
    by_message = re.search(
        r"compression_mode:\W*message", text_of(folder / METADATA), re.IGNORECASE
    )
    for kind, found in (
        ("a sqlite3 bag", any(folder.glob("*.db3*"))),
        ("compressed by rosbag2", by_message or any(folder.glob("*.zstd"))),
    ):
        if found:
            raise BagError(
                f"{folder} is {kind}; expected MCAP (with compressed chunks, if any). Convert it: "
                f"rosbags-convert --src {folder} --dst {folder}-mcap --dst-storage mcap"
            )
    return sorted(folder.glob("*.mcap"), key=lambda path: (len(path.name), path.name))


def text_of(path: Path) -> str:
    """The beginning of a text file beside a bag; empty if there is none."""
    try:
        with path.open("rb") as file:
            return file.read(MAX_TEXT).decode(errors="replace")
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise BagError(f"{path} cannot be read: {error.strerror}") from error
