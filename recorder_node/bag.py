"""One rosbag2 bag that is written as it grows: MCAP or sqlite3, from serialised bytes. No ROS import.

What `flush` has written survives SIGKILL: an MCAP file is whole chunks up to there (readable record
by record without its footer), a sqlite3 file is committed up to there. The message definitions are
in the bag, so that it is read without ROS.
"""

from __future__ import annotations

import os
import sqlite3
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.rosbag2.enums import CompressionMode
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer
from rosbags.typesys import Stores, get_typestore

STORAGES = ("mcap", "sqlite3")
_MESSAGE = struct.Struct("<BQHIQQ")
"""An MCAP message record up to its data: opcode, length, channel, sequence, log and publish time."""
LARGE, LARGEST = 2**20, 2**26
"""Bytes of an MCAP chunk that is closed at the next pause, and of one that is closed at once."""


class BagError(RuntimeError):
    """A bag that cannot be begun, written or read; the text says why and what to do."""


@dataclass(frozen=True)
class Channel:
    """A recorded topic: its full name, its type, and whether its publisher is transient local."""

    topic: str
    type: str
    latched: bool


class BagWriter:
    """Writes one bag into the new folder `path`.

    storage: one of STORAGES. Raises BagError, at any time, when the disk refuses.
    """

    def __init__(self, path: Path, storage: str, channels: Sequence[Channel]) -> None:
        if path.exists():
            raise BagError(f"{path} already exists; choose another folder for the bag")
        self.path = path
        self.messages = 0
        self._writer = _Writer(path, storage)
        try:
            self._writer.open()
            self._connections = {
                channel.topic: self._writer.add_connection(
                    channel.topic,
                    channel.type,
                    typestore=_TYPES,
                    offered_qos_profiles=[_offered(channel)],
                )
                for channel in channels
            }
            self._storage.flush()
        except (OSError, sqlite3.Error, WriterError) as error:
            raise BagError(f"cannot write a bag to {path}: {_reason(error)}") from error

    def write(self, topic: str, when: int, data: bytes) -> None:
        """Append a serialised message; when: time of its arrival, ns since the epoch."""
        try:
            self._writer.write(self._connections[topic], when, data)
        except (OSError, sqlite3.Error) as error:
            raise self._stopped(error) from error
        self.messages += 1

    def pause(self) -> None:
        """Between two batches of messages, each of which is kept as a whole or not at all: write what
        has become large.
        """
        try:
            self._storage.pause()
        except OSError as error:
            raise self._stopped(error) from error

    def flush(self) -> None:
        """Hand everything to the operating system, in a form that can be read back."""
        try:
            self._storage.flush()
        except (OSError, sqlite3.Error) as error:
            raise self._stopped(error) from error

    def close(self, notes: Mapping[str, str]) -> None:
        """Finish the bag: indices, and metadata.yaml with `notes` as its custom data."""
        for key, value in notes.items():
            self._writer.set_custom_data(key, value)
        try:
            self._storage.flush()
            self._writer.close()
        except (OSError, sqlite3.Error) as error:
            raise self._stopped(error) from error

    def abandon(self) -> None:
        """Give up; what was flushed stays."""
        try:
            self._writer.abort()
        except (OSError, sqlite3.Error):
            return

    @property
    def _storage(self) -> _Mcap | _Sqlite3:
        storage = self._writer.storage
        assert isinstance(storage, (_Mcap, _Sqlite3))
        return storage

    def _stopped(self, error: Exception) -> BagError:
        self.abandon()
        return BagError(
            f"cannot write to {self.path}: {_reason(error)}; recording stopped, what was written "
            f"before can be read (pdeloop bag recover {self.path} makes it an ordinary bag)"
        )


class _File:
    """A file without a buffer that writes all or raises, and can forget an unfinished end."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._position = 0
        self._open = True

    def write(self, data: bytes | memoryview) -> int:
        rest = memoryview(data).cast("B")
        while rest:
            count = os.write(self._descriptor, rest)
            rest = rest[count:]
            self._position += count
        return len(data)

    def tell(self) -> int:
        return self._position

    def truncate(self, size: int) -> None:
        os.ftruncate(self._descriptor, size)

    def close(self) -> None:
        if self._open:
            self._open = False
            os.close(self._descriptor)


class _Mcap(McapWriter):
    """MCAP whose chunks can be closed at any time; a chunk that does not fit the disk is removed."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        head = self.bio.tell()
        self.bio.flush()
        start = self.path.read_bytes()[:head]
        self.bio.close()
        self.path.unlink()
        self.bio: Any = _File(self.path)
        self.bio.write(start)

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        # As in the parent class, with one struct instead of seven writes.
        chunk, channel = self.chunk, connection.id
        if timestamp < chunk.message_start_time:
            chunk.message_start_time = timestamp
            self.message_start_time = min(timestamp, self.message_start_time)
        if timestamp > chunk.message_end_time:
            chunk.message_end_time = timestamp
            self.message_end_time = max(timestamp, self.message_end_time)
        self.channel_stats[channel] += 1
        content = chunk.bio
        position = content.tell()
        chunk.msgs[channel].append((timestamp, position))
        content.write(_MESSAGE.pack(5, 22 + len(data), channel, 0, timestamp, timestamp))
        content.write(data)
        if position > LARGEST:
            self.close_chunk()

    def close_chunk(self) -> None:
        begin = self.bio.tell()
        try:
            super().close_chunk()
        except OSError:
            self.bio.truncate(begin)
            raise

    def pause(self) -> None:
        if self.chunk.bio.tell() > LARGE:
            self.close_chunk()

    def flush(self) -> None:
        if self.chunk.msgs:
            self.close_chunk()


class _Sqlite3(Sqlite3Writer):
    """sqlite3 that can be committed at any time."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        self.conn.execute("PRAGMA synchronous=NORMAL")

    def pause(self) -> None:
        pass

    def flush(self) -> None:
        self.conn.commit()


class _Writer(Writer):
    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        # The parent class compares the connection with every one it has.
        assert self.storage is not None
        self.storage.write(connection, timestamp, data)
        self.counts[connection.id] += 1
        if timestamp < self.min_timestamp:
            self.min_timestamp = timestamp
        if timestamp > self.max_timestamp:
            self.max_timestamp = timestamp

    STORAGE_PLUGINS: Mapping[StoragePlugin, Any] = {  # as in the parent class
        StoragePlugin.MCAP: _Mcap,
        StoragePlugin.SQLITE3: _Sqlite3,
    }

    def __init__(self, path: Path, storage: str) -> None:
        super().__init__(  # metadata.yaml as ROS 2 Jazzy writes it
            path, version=9, storage_plugin=StoragePlugin[storage.upper()]
        )


_TYPES = get_typestore(Stores.ROS2_JAZZY)


def _offered(channel: Channel) -> Qos:
    forever = QosTime(9223372036, 854775807)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if channel.latched else QosDurability.VOLATILE,
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
