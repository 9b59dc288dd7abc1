# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Damaged and hostile bags: one sentence, in bounded memory."""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, Header, McapRecord, Schema
from mcap.writer import MCAP0_MAGIC as MAGIC

from pdeloop.bags.info import describe
from pdeloop.bags.reader import Bag
from recorder_node.bag import BagError
from tests.support.interpreter import python
from tests.support.written_bag import written


def record_bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def chunk(content: bytes, size: int) -> Chunk:
    return Chunk(
        compression="zstd",
        data=content,
        message_start_time=1,
        message_end_time=2,
        uncompressed_crc=0,
        uncompressed_size=size,
    )


def crafted(folder: Path, *records: bytes) -> Path:
    """A bag of these records."""
    folder.mkdir()
    header = record_bytes(Header("ros2", ""))
    (folder / "x.mcap").write_bytes(MAGIC + header + b"".join(records) + MAGIC)
    return folder


def zeros() -> bytes:
    """2 GiB of them, compressed."""
    compressor = zstandard.ZstdCompressor(level=1).compressobj()
    parts = [compressor.compress(bytes(2**24)) for _ in range(128)]
    return b"".join(parts) + compressor.flush()


MEMORY = """
import resource, sys
from pdeloop.cli import main
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for bag in sys.argv[1:]:
    for command in (("bag", "info"), ("bag", "verify"), ("identify", "--bag")):
        assert main([*command, bag]) == 1
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def test_a_small_file_that_becomes_gigabytes_is_refused_in_one_sentence(tmp_path):
    """Both kinds of file: one that says how large it becomes, and one that does not."""
    content = zeros()
    told = [
        crafted(tmp_path / str(size), record_bytes(chunk(content, size))) for size in (2**31, 1000)
    ]
    assert all((bag / "x.mcap").stat().st_size < 2**20 for bag in told)
    ended = python("-c", MEMORY, *told)
    lines = ended.stderr.splitlines()
    assert len(lines) == 6
    assert all("decompresses to more than 100 times" in line for line in lines[:3])
    assert all("a chunk does not" in line for line in lines[3:])
    assert int(ended.stdout) < 300


SCHEMA = Schema(id=1, name="a/msg/B", encoding="ros2msg", data=b"")
TOPIC = McapChannel(id=1, topic="/a", message_encoding="cdr", metadata={}, schema_id=1)


def message_bytes(size: int) -> bytes:
    return struct.pack("<BQHIQQ", 5, 22 + size, 1, 0, 1, 1) + bytes(size)


@pytest.mark.parametrize("more", [-1, 0, 1, 100])
def test_a_chunk_of_another_size_than_it_says_is_refused(tmp_path, more):
    message = message_bytes(8)
    made = chunk(zstandard.compress(message), len(message) + more)
    bag = Bag(crafted(tmp_path / "bag", *map(record_bytes, (SCHEMA, TOPIC, made))))
    if more:
        with pytest.raises(BagError, match="cannot be read, as it is damaged"):
            list(bag.messages())
    else:
        assert [len(found.data) for found in bag.messages()] == [8]


def test_many_chunks_are_bounded_together(tmp_path):
    size = 30 * 2**20
    message = message_bytes(size)
    known = [record_bytes(SCHEMA), record_bytes(TOPIC)]
    chunks = [record_bytes(chunk(zstandard.compress(message), len(message)))]
    bag = Bag(crafted(tmp_path / "two", *known, *chunks * 2))
    assert [len(found.data) for found in bag.messages()] == [size, size]
    bag = Bag(crafted(tmp_path / "twenty", *known, *chunks * 20))
    with pytest.raises(BagError, match=r"decompresses to more than 100 times its size"):
        list(bag.messages())


@pytest.mark.parametrize("length", [0, 1, 5, 23, 2**40, 2**64 - 1])
def test_hostile_records_are_one_sentence_or_no_messages(tmp_path, length):
    for opcode in range(1, 16):
        record = struct.pack("<BQ", opcode, length) + b"\xff" * min(length, 100)
        try:
            assert list(Bag(crafted(tmp_path / f"{opcode}", record)).messages()) == []
        except BagError as error:
            assert "cannot be read, as it is damaged" in str(error) and "\n" not in str(error)


@pytest.mark.parametrize("name", ["/\x1b]0;title\x07", "/two\nlines", "/" + "x" * 300])
def test_a_name_that_is_not_to_be_printed_is_refused(tmp_path, name):
    topic = McapChannel(id=1, topic=name, message_encoding="cdr", metadata={}, schema_id=0)
    with pytest.raises(BagError, match=r"damaged: .* a topic's name or type is '[ -~]+'; exp"):
        describe(crafted(tmp_path / "topic", record_bytes(topic)))


def test_the_records_of_a_chunk_are_read_one_by_one(tmp_path):
    """Those before one that is cut off are read; its absence is named."""
    topic = McapChannel(id=1, topic="/a", message_encoding="cdr", metadata={}, schema_id=0)
    message = struct.pack("<BQHIQQ", 5, 22, 1, 0, 1, 1)
    content = record_bytes(topic) + message * 2 + message[:5]
    cut = record_bytes(chunk(zstandard.compress(content), len(content)))
    bag = Bag(crafted(tmp_path / "bag", cut))
    assert [message.topic for message in bag.messages()] == ["/a", "/a"]
    (damage,) = bag.findings().missing
    assert damage.startswith("what is damaged of x.mcap (the chunk at byte ")


def test_a_damaged_chunk_is_noticed_by_its_checksum(tmp_path):
    path = written(tmp_path) / "bag.mcap"
    content = path.read_bytes()
    place = content.index(b"zstd") + 12
    path.write_bytes(content[:place] + b"\0" + content[place + 1 :])
    with pytest.raises(BagError, match=r"checksum|damaged"):
        list(Bag(path.parent).messages())


@settings(derandomize=True, deadline=None, database=None, max_examples=150)
@given(
    places=st.lists(st.tuples(st.floats(0, 1), st.integers(1, 255)), max_size=3),
    kept=st.floats(0, 1),
)
def test_a_damaged_bag_is_refused_in_a_sentence_or_gives_messages_that_were_recorded(
    undamaged, places, kept
):
    path, whole, content = undamaged
    damaged = bytearray(content)
    for place, flipped in places:
        damaged[int(place * (len(content) - 1))] ^= flipped
    path.write_bytes(damaged[: int(len(content) * (kept if kept > 0.5 else 1))])
    try:
        found = Counter((m.when, m.data) for m in Bag(path.parent).messages())
        list(Bag(path.parent).episodes())
    except BagError as error:
        assert "\n" not in str(error)
    else:
        assert found <= whole


@pytest.fixture(scope="module")
def undamaged(tmp_path_factory):
    """A bag's file, its messages and its content."""
    path = written(tmp_path_factory.mktemp("bag")) / "bag.mcap"
    messages = Counter((m.when, m.data) for m in Bag(path.parent).messages())
    return path, messages, path.read_bytes()
