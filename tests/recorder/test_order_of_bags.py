# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Bags whose messages lie in another order than that of their times, or whose ends are damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pdeloop.bags import mcap_messages
from pdeloop.bags.mcap_messages import Message
from pdeloop.bags.reader import Bag
from pdeloop.bags.verify import verify
from pdeloop.cli import main
from pdeloop.identification import identify_bag
from recorder_node.bag import BagError
from tests.support.recorded_here import write
from tests.support.verified_bag import EPISODES, verified, words_of

Order = Callable[[list[Message]], list[list[Message]]]
ORDERS: dict[str, Order] = {
    "topic after topic": lambda all_: [sorted(all_, key=lambda m: (m.topic, m.when))],
    "newest first": lambda all_: [all_[::-1]],
    "any order": lambda all_: [[all_[i] for i in np.random.default_rng(0).permutation(len(all_))]],
    "a file of states": lambda all_: [
        [m for m in all_ if m.topic == "/state"],
        [m for m in all_ if m.topic != "/state"],
    ],
    "every other message": lambda all_: [all_[1::2], all_[::2]],
}


def same(found: Path, run: Path) -> None:
    """A bag holds a run: verified, and identified, as the bag in its order is."""
    report = verify(found)
    assert not report.incomplete and not report.count, report.text()
    assert report.episodes == EPISODES
    one, other = (identify_bag(bag, {}) for bag in (found, run / "bag"))
    assert np.array_equal(one.model.A, other.model.A)
    assert one.sources == other.sources


@pytest.mark.parametrize("order", ORDERS)
def test_a_bag_is_read_by_the_times_of_its_messages(run, messages, tmp_path, order):
    bag = write(tmp_path / "bag", ORDERS[order](messages))
    assert [m.when for m in Bag(bag).messages()] == [m.when for m in messages]
    same(bag, run)


def test_a_bag_that_would_have_to_be_held_is_refused_with_the_remedy(
    messages, tmp_path, monkeypatch
):
    monkeypatch.setattr(mcap_messages, "TOGETHER", 1000)
    in_order = write(tmp_path / "in_order", [messages])
    assert len(list(Bag(in_order).messages())) == len(messages)
    bag = write(tmp_path / "bag", ORDERS["every other message"](messages))
    with pytest.raises(BagError, match="mcap sort"):
        list(Bag(bag).messages())


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "zeros after the end": lambda content: content + bytes(4096),
    "zeros over the summary": lambda content: content[:-200] + bytes(200),
    "a wrong bit in the summary": lambda content: (
        content[:-100] + bytes([content[-100] ^ 1]) + content[-99:]
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_whole_of_a_damaged_bag_is_read(run, tmp_path, damage, capsys):
    path = run / "bag" / "bag.mcap"
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    same(run / "bag", run)
    if "bit" not in damage:
        assert "mcap recover bag.mcap" in words_of(verify(run)) and verified(run) == 1
        assert main(["bag", "info", str(run)]) == 0
        assert "mcap recover" in capsys.readouterr().out


def test_a_wrong_bit_in_a_chunk_costs_that_chunk_alone(messages, tmp_path):
    """Two files of chunks: the first one's only chunk is lost, which is named."""
    half = len(messages) // 2
    bag = write(tmp_path / "bag", [messages[:half], messages[half:]])
    path = bag / "bag_0.mcap"
    content = bytearray(path.read_bytes())
    content[content.index(b"zstd") + 2000] ^= 1
    path.write_bytes(bytes(content))
    assert [m.when for m in Bag(bag).messages()] == [m.when for m in messages[half:]]
    (damage,) = [text for text in Bag(bag).findings().missing if "damaged" in text]
    assert "of bag_0.mcap (the chunk at byte" in damage and "mcap recover" in damage
