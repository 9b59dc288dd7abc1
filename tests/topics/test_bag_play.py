"""A bag played over topics: the same bytes in the same order and time, never beside a loop."""

from __future__ import annotations

import itertools
import re
import signal
from pathlib import Path

import pytest

from pdeloop.bags.mcap_messages import Message
from pdeloop.bags.node import timed
from pdeloop.bags.reader import Bag
from tests.browser import browser
from tests.loop_harness import Processes, until, without_domain
from tests.small import SMALL
from tests.topics.test_monitor import FIELD, LIMIT, PAINTED, ROLLOUTS, STATE, address, card

pytestmark = pytest.mark.topics


@pytest.fixture
def bag(recorded: Path) -> Path:
    """The folder of a small recorded run."""
    return recorded


def by_topic(messages: list[Message]) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    for message in messages:
        if message.topic in ("/diagnostics", "/rosout"):
            continue  # player and recorder publish there, too
        found.setdefault(message.topic, []).append(message.data)
    return found


def lasting(bag: Path, seconds: float) -> float:
    """The rate at which the bag is played within so many seconds."""
    times = [message.when for message in Bag(bag).messages()]
    return (times[-1] - times[0]) / 1e9 / seconds


def slowness(original: Bag, bag: Bag) -> float:
    """How much longer the states took in `bag`."""
    times = [
        [message.when for message in b.messages() if message.topic == "/state"]
        for b in (original, bag)
    ]
    return (times[1][-1] - times[1][0]) / (times[0][-1] - times[0][0])


def test_what_is_played_can_be_recorded_again_to_the_byte(loop: Processes, tmp_path, bag):
    original, rate = Bag(bag), lasting(bag, 8.0)  # so slowly that a busy machine loses nothing
    recorder = loop.node("recorder_node", "-p", f"bag:={tmp_path / 'again'}")
    until(lambda: "recording to" in loop.output(recorder), LIMIT, "recorder")
    player = loop.pdeloop("bag", "play", str(bag), "--rate", str(rate))
    loop.wait(player, LIMIT)
    recorder.send_signal(signal.SIGINT)
    loop.wait(recorder, LIMIT)
    again, before = (
        by_topic(list(Bag(tmp_path / "again").messages())),
        by_topic(list(original.messages())),
    )
    assert set(again) == set(before)
    for topic, messages in before.items():
        # The first ones may have gone before the recorder knew of the publisher, but nothing after.
        missing = len(messages) - len(again[topic])
        assert 0 <= missing < 0.2 * len(messages) + 1, topic
        assert again[topic] == messages[missing:], topic
    assert 0.5 < slowness(original, Bag(tmp_path / "again")) * rate < 2.0


def test_a_bag_is_not_played_beside_a_live_loop(loop, bag):
    plant = loop.node("pde_sim_node", "--params-file", str(SMALL))
    until(lambda: "4 actuators" in loop.output(plant), LIMIT, "plant")
    text = loop.wait(loop.pdeloop("bag", "play", str(bag)), LIMIT, code=1)
    assert "/pde_sim_node publishes /" in text and "live loop" in text
    assert "Traceback" not in text and "messages published" not in text


def test_the_monitor_shows_a_bag_that_is_played(loop: Processes, tmp_path, bag):
    rate = str(lasting(bag, 20.0))
    with without_domain(loop), browser(tmp_path) as page:
        player = loop.pdeloop("bag", "play", str(bag), "--loop", "--rate", rate)
        monitor = loop.pdeloop("monitor", "--port", "0")
        page.go(address(loop, monitor))
        page.until(f"{STATE} === 'running'", LIMIT)
        page.until(f"{ROLLOUTS} >= 2", LIMIT)
        page.wait_for(lambda: page.ask(PAINTED % "field") > 250, LIMIT, "picture of the field")
        who = "(adapted|LQT|no control|exploration)"
        page.until(f"/episode \\d+ \\({who}\\)/.test({FIELD})", LIMIT)
        assert "/bag_player" in card(page, "plant")
        assert page.ask("document.querySelector('#problem').textContent") == "small"
        assert page.ask("document.querySelector('#plant-pause').disabled")
        assert page.console == []
        player.send_signal(signal.SIGINT)
        text = loop.wait(player, LIMIT, code=130)
    assert re.search(r"\d+ messages published, stopped by SIGINT", text)


def test_a_bag_that_is_none_is_told_in_one_line(loop: Processes, tmp_path):
    text = loop.wait(loop.pdeloop("bag", "play", str(tmp_path / "none")), LIMIT, code=1)
    assert "no bag at" in text and len(text.strip().splitlines()) == 1
    text = loop.wait(loop.pdeloop("bag", "play", str(tmp_path), "--rate", "0"), LIMIT, code=1)
    assert "--rate" in text


def test_the_recorded_quality_of_service_is_that_of_the_loop(bag, tmp_path):
    found = {channel.topic: channel for channel in Bag(bag).channels()}
    assert found["/target"].latched and found["/episode/cost"].latched
    assert not found["/state"].latched and found["/state"].reliable
    assert found["/clock"].type == "rosgraph_msgs/msg/Clock"
    # Of an unfinished bag, which has no metadata, it is that of the loop's table.
    unfinished = tmp_path / "unfinished"
    unfinished.mkdir()
    (source,) = (bag / "bag").glob("*.mcap")
    (unfinished / source.name).write_bytes(source.read_bytes())
    again = {channel.topic: channel for channel in Bag(unfinished).channels()}
    assert len(again) > 6
    for topic, channel in again.items():
        assert (channel.type, channel.latched) == (found[topic].type, found[topic].latched)


def test_messages_are_due_in_the_recorded_time():
    messages = [
        Message("/state", "", when, b"") for when in (5_000_000_000, 4_000_000_000, 7_000_000_000)
    ]
    # A cost stands behind the samples that it is about, which came after it.
    due = (0.0, -0.25, 0.5)
    assert list(timed(lambda: messages, 4.0)) == list(zip(due, messages, strict=True))
    twice = list(itertools.islice(timed(lambda: messages, 4.0, again=True), 6))
    assert [when for when, _ in twice] == [*due, 0.5, 0.25, 1.0]
    assert list(timed(list, 1.0, again=True)) == []
