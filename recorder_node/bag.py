# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A rosbag2 bag that is written as it grows: one MCAP file and metadata.yaml. No ROS import.

What `flush` has written survives SIGKILL: the MCAP file consists of whole chunks up to there, which
are compressed with zstd. The message definitions are in the bag, so that it is read without ROS.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Any, cast

import yaml
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from pdeloop.messages.files import write_atomically

FILE, METADATA = "bag.mcap", "metadata.yaml"
VERSION = 9
"""Version of metadata.yaml in ROS 2 Jazzy."""
LARGE, LARGEST = 2**20, 2**26
"""Bytes of a chunk that is closed at the next pause, and of one that is closed at once."""
QOS, HASH = "offered_qos_profiles", "topic_type_hash"
"""Keys of a channel's metadata in the MCAP file."""


class BagError(RuntimeError):
    """A bag that cannot be begun, written or read; the text says why and what to do."""


@dataclass(frozen=True)
class Channel:
    """A recorded topic: its full name, its type, and what its publisher offers."""

    topic: str
    type: str
    latched: bool = False
    reliable: bool = True
    depth: int = 1

    def qos(self) -> dict[str, Any]:
        """The offered quality of service, as rosbag2 writes it."""
        forever = {"sec": 9223372036, "nsec": 854775807}
        return {
            "history": "keep_last",
            "depth": self.depth,
            "reliability": "reliable" if self.reliable else "best_effort",
            "durability": "transient_local" if self.latched else "volatile",
            "deadline": forever,
            "lifespan": forever,
            "liveliness": "automatic",
            "liveliness_lease_duration": forever,
            "avoid_ros_namespace_conventions": False,
        }


@cache
def definition(kind: str) -> tuple[str, str]:
    """The text that defines a message type of ROS 2 Jazzy and all it refers to, and its RIHS01 hash."""
    types = _jazzy()
    text, _ = types.generate_msgdef(kind, ros_version=2)
    return text, types.hash_rihs01(kind)


@cache
def _jazzy() -> Any:
    return get_typestore(Stores.ROS2_JAZZY)


class BagWriter:
    """Writes one bag into a new folder. BagError where it is there already or the disk refuses."""

    def __init__(self, path: Path, channels: Iterable[Channel]) -> None:
        if path.exists():
            raise BagError(f"{path} already exists; choose another folder for the bag")
        self.path = path
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, Channel] = {}
        self._numbers: dict[str, int] = {}
        self._counts: Counter[str] = Counter()
        self._first, self._last = 2**63, 0
        self._pending = 0
        """Bytes of messages that are not in the file yet."""
        try:
            path.mkdir(parents=True)
            self._file = _WholeWrites(path / FILE)
            self._mcap = Writer(cast("IO[bytes]", self._file), chunk_size=LARGEST)
            self._mcap.start("ros2", "pdeloop")
        except OSError as error:
            raise BagError(f"cannot write a bag to {path}: {_reason(error)}") from error
        for channel in channels:
            self._add(channel)

    def _add(self, channel: Channel) -> None:
        kind, (text, hashed) = channel.type, definition(channel.type)
        if kind not in self._schemas:
            self._schemas[kind] = self._mcap.register_schema(kind, "ros2msg", text.encode())
        metadata = {QOS: _yaml([channel.qos()]), HASH: hashed}
        number = self._mcap.register_channel(channel.topic, "cdr", self._schemas[kind], metadata)
        self._numbers[channel.topic], self._channels[channel.topic] = number, channel

    @property
    def messages(self) -> int:
        """Number of written messages."""
        return self._counts.total()

    def write(self, topic: str, when: int, data: bytes) -> None:
        """Append a serialised message; when: time of its arrival, ns since the epoch."""
        try:
            self._mcap.add_message(self._numbers[topic], when, data, when)
        except OSError as error:
            raise self._stopped(error) from error
        self._counts[topic] += 1
        self._pending += len(data)
        self._first, self._last = min(self._first, when), max(self._last, when)

    def pause(self) -> None:
        """Write what has become large.

        To be called between two batches of messages: each is kept as a whole or not at all.
        """
        if self._pending > LARGE:
            self.flush()

    def flush(self) -> None:
        """Hand everything to the operating system, in a form that can be read back."""
        try:
            self._mcap.flush()
        except OSError as error:
            raise self._stopped(error) from error
        self._pending = 0

    def close(self) -> None:
        """Finish the bag: indices, and metadata.yaml."""
        self.flush()
        information = self._information()
        try:
            # As rosbag2 does it: a file without its folder says as much.
            self._mcap.add_metadata("rosbag2", {"serialized_metadata": _yaml(information)})
            self._mcap.finish()
            self._file.close()
            text = _yaml({"rosbag2_bagfile_information": information})
            write_atomically(self.path / METADATA, text.encode())
        except OSError as error:
            raise self._stopped(error) from error

    def _information(self) -> dict[str, Any]:
        """The content of metadata.yaml, without its outermost key."""
        first, last = (self._first, self._last) if self._counts else (0, 0)
        extent = {
            "duration": {"nanoseconds": last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": self.messages,
        }
        topics = [
            {
                "topic_metadata": {
                    "name": channel.topic,
                    "type": channel.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [channel.qos()],
                    "type_description_hash": definition(channel.type)[1],
                },
                "message_count": self._counts[channel.topic],
            }
            for channel in self._channels.values()
        ]
        return {
            "version": VERSION,
            "storage_identifier": "mcap",
            "relative_file_paths": [FILE],
            **extent,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": FILE, **extent}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }

    def _stopped(self, error: OSError) -> BagError:
        self._file.close()
        return BagError(
            f"cannot write to {self.path}: {_reason(error)}; recording has stopped, but what was "
            "written before can be read (docs/recording.md)"
        )


class _WholeWrites:
    """A new file in which each write is there as a whole or, if the disk refuses, not at all."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)
        self.tell, self.flush, self.close = self._file.tell, self._file.flush, self._file.close

    def write(self, data: bytes) -> None:
        begin, rest = self._file.tell(), memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            self._file.truncate(begin)
            raise


def _yaml(content: Any) -> str:
    return yaml.dump(content, Dumper=_Plain, sort_keys=False, width=2**16)


class _Plain(yaml.SafeDumper):
    """Writes what occurs twice twice: rosbag2's reader may not follow YAML's references."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _reason(error: OSError) -> str:
    return error.strerror or str(error)
