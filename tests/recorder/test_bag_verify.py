# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What is missing from a bag, or otherwise than its metadata and its run say, is named; rc 1."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pdeloop.bags.mcap_messages import Message
from pdeloop.bags.verify import verify
from pdeloop.identification import identify_bag
from pdeloop.messages.samples import clock_message
from recorder_node.recording import PARAMETERS_TOPIC, source_of
from tests.support.recorded_here import PART, change_metadata, episode_of, record_run, write
from tests.support.verified_bag import EPISODES, HORIZON, by_episodes, verified, words_of


def test_a_whole_run_is_verified_with_its_results(run, capsys):
    report = verify(run)
    assert report.good and not (report.incomplete or report.notes), report.text()
    assert report.episodes == EPISODES
    assert report.compared["results"] > 0
    assert verified(run) == 0
    assert capsys.readouterr().out.endswith("no difference, to the bit\n")


def test_a_run_whose_first_exploration_diverged_is_followed_and_identified_from_the_other(tmp_path):
    record_run(tmp_path / "run", exploration_variance=100.0, divergence_bound=3.2)
    report = verify(tmp_path / "run")
    assert report.good and not (report.incomplete or report.notes), report.text()
    found = identify_bag(tmp_path / "run" / "bag", {})
    assert {source["episode"] for source in found.sources} == {PART + 1}


def test_a_lost_end_is_seen_by_what_the_run_says(run, messages):
    """The training's last episodes, of which the bag says nothing."""
    shutil.rmtree(run / "bag")
    write(run / "bag", by_episodes(messages, 4)[:1])
    assert verify(run / "bag").missing == verify(run).missing
    (missing,) = verify(run).missing
    assert "18 rollouts that the training asked for (adaptation 4, evaluation 14)" in missing
    elsewhere = run.parent / "bag"
    shutil.copytree(run / "bag", elsewhere)
    assert verify(elsewhere).good  # a recorder may have ended there
    for name in ("result.json", "policy.npz"):
        (run / name).unlink()
    (missing,) = verify(run).missing
    assert (
        "4 rollouts that the training asked for (adaptation 4)" in missing
    )  # as progress.jsonl says


def test_a_single_file_that_is_cut_off_is_named(run):
    path = run / "bag" / "bag.mcap"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "the end of bag.mcap: it is cut off" in words_of(verify(run))
    assert verified(run) == 1
    (run / "bag" / "metadata.yaml").unlink()  # as if the recorder had been killed
    assert verified(run) == 1


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "more in all": (lambda m: m.update(message_count=m["message_count"] + 1), "says"),
    "more in a file": (
        lambda m: m["files"][0].update(message_count=m["files"][0]["message_count"] + 1),
        "bag.mcap has",
    ),
    "fewer in a file": (lambda m: m["files"][0].update(message_count=1), "metadata.yaml says 1"),
    "more in a topic": (
        lambda m: m["topics_with_message_count"][1].update(message_count=10**6),
        "of 1000000 of /",
    ),
    "another topic": (
        lambda m: m["topics_with_message_count"].append(
            {"topic_metadata": {"name": "/lost"}, "message_count": 3}
        ),
        "0 of 3 of /lost",
    ),
    "a topic less": (lambda m: m["topics_with_message_count"].pop(1), "of 0 of /"),
    "an earlier begin": (
        lambda m: m["starting_time"].update(nanoseconds_since_epoch=1),
        "metadata.yaml says from 1 to",
    ),
    "a longer file": (
        lambda m: m["files"][0]["duration"].update(nanoseconds=2),
        "the messages of bag.mcap are from",
    ),
    "a file twice": (lambda m: m["relative_file_paths"].append("bag.mcap"), "bag.mcap 2 times"),
    "a file more": (lambda m: m["relative_file_paths"].append("bag_1.mcap"), "the file bag_1.mcap"),
    "hostile names": (
        lambda m: m["relative_file_paths"].append("\x1b]0;t\x07" + "x" * 9000),
        r"the file \x1b]0;t\x07xxx",
    ),
    "no list of files": (lambda m: m.pop("relative_file_paths"), "is not what rosbag2 writes"),
    "no numbers": (lambda m: m.update(message_count="many"), "a number is 'many'"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_each_thing_that_metadata_says_is_compared(run, name):
    change, words = CHANGES[name]
    change_metadata(run / "bag", change)
    report = verify(run)
    assert not report.good
    assert words in words_of(report)
    assert max(map(len, words_of(report).splitlines())) < 1000
    assert "no difference" not in report.text()


def test_metadata_that_is_no_yaml_is_named_and_the_rest_verified(run):
    (run / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: {a: &a [*a]}\n")
    report = verify(run)
    assert "is not valid YAML" in words_of(report)
    assert report.compared["costs"] == 2 + 4 + 3 * 4 + 12 + 2


@pytest.mark.parametrize("topic", ["/state", "/action", "/episode/cost", "/policy"])
def test_a_single_message_that_is_nowhere_counted_is_missed(run, messages, topic):
    lost = next(m for m in messages if m.topic == topic and episode_of(m) == PART + 2)
    shutil.rmtree(run / "bag")
    write(run / "bag", [[m for m in messages if m is not lost]])
    report = verify(run)
    assert "episode 1.3 lacks" in words_of(report)
    # Two of them are there once more, at the end.
    said = "4 rollouts that the training asked for (adaptation 2, evaluation 2)"
    assert said in words_of(report)
    assert not report.good
    assert not verify(run / "bag").good


def test_an_episode_that_was_repeated_lacks_nothing(run, messages):
    """As after a plant that was killed: the tuner has started the same rollouts again."""
    number = PART + 2
    doubled: list[Message] = []
    for message in messages:
        own = episode_of(message)
        source = source_of(message.topic)
        if own >= number and source is not None and source.array is not None:
            frame = source.codec.decode(message.data)
            if own == number and message.topic in ("/policy", "/episode/start"):
                doubled.append(message)  # of the episode that came to nothing
            codec = source.array.codec()
            raw = codec.encode(replace(frame, episode=frame.episode + 1))
            doubled.append(replace(message, data=raw))
        else:
            doubled.append(message)
    shutil.rmtree(run / "bag")
    write(run / "bag", [doubled])
    report = verify(run)
    assert report.incomplete == ["episode 1.3 lacks its cost"]
    assert report.good, report.text()


RUN_FILES: dict[str, tuple[str, Callable[[dict[str, Any]], Any], str]] = {
    "a better cost": (
        "result.json",
        lambda c: c["costs_by_field"]["adapted"][0].__setitem__(0, 0.5),
        "'adapted' of",
    ),
    "a better mean": (
        "result.json",
        lambda c: c["mean_cost"].update(adapted=0.5),
        "'mean_cost' of",
    ),
    "another outcome": (
        "result.json",
        lambda c: c["outcome"][0].update(verdict="better than ever"),
        "'outcome' of",
    ),
    "another reduction": (
        "result.json",
        lambda c: c["reduction"].update(ratio_of_means=0.99),
        "'reduction' of",
    ),
    "another history": (
        "result.json",
        lambda c: c["history"][1].update(rollouts=99),
        "row 1: rollouts is 99",
    ),
    "a longer history": (
        "result.json",
        lambda c: c["history"].append(c["history"][-1]),
        "rows, the training has",
    ),
    "another run": ("run.json", lambda c: c.update(run=7), "all episodes of run 7"),
    "another horizon": (
        "run.json",
        lambda c: c["parameters"].update(horizon=31),
        f"parameter 'horizon' is {HORIZON} in the bag and 31 in",
    ),
    "no run": ("run.json", lambda c: c.pop("run"), "run.json cannot be read: it lacks 'run'"),
    "no costs": ("result.json", lambda c: c.pop("costs_by_field"), "result.json cannot be read"),
    "parameters of another": (
        "bag/parameters.json",
        lambda c: next(iter(c.values())).update(horizon=31),
        "parameters.json differs from the bag itself in a parameter of run",
    ),
}


@pytest.mark.parametrize("name", RUN_FILES)
def test_what_the_run_says_is_compared(run, name):
    file, change, words = RUN_FILES[name]
    content = json.loads((run / file).read_text())
    change(content)
    (run / file).write_text(json.dumps(content))
    report = verify(run)
    assert not report.good
    assert words in words_of(report)


def test_another_policy_than_the_trainings_is_a_difference(run):
    with np.load(run / "policy.npz") as archive:
        arrays = dict(archive)
    arrays["policy"][0, 0, 0] = np.nextafter(arrays["policy"][0, 0, 0], 1.0)
    np.savez(run / "policy.npz", **arrays)
    assert f"the policy in {run}" in words_of(verify(run))


def test_a_target_alone_is_not_a_verified_bag(messages, tmp_path, capsys):
    """Of every episode the cost is missing, so that none is run again; the target is the plant's."""
    bag = write(tmp_path / "bag", [[m for m in messages if m.topic != "/episode/cost"]])
    report = verify(bag)
    assert report.compared["targets"] == 1 and report.recomputed == 0
    assert not report.good and "no difference" not in report.text()
    assert len(report.unverified) == 1 and report.unverified[0].startswith("run ")
    assert verified(bag) == 1
    assert "nothing was recomputed" in capsys.readouterr().err


def test_how_many_episodes_were_run_again_is_said(run, messages, tmp_path):
    lost = next(m for m in messages if m.topic == "/state" and episode_of(m) == PART + EPISODES - 1)
    bag = write(tmp_path / "bag", [[m for m in messages if m is not lost]])
    report = verify(bag)
    assert report.recomputed == EPISODES - 1 == report.episodes - 1


@pytest.mark.parametrize("name", ["progress.jsonl", "result.json", "run.json", "policy.npz"])
def test_a_file_that_the_run_lacks_is_named(run, name):
    (run / name).unlink()
    assert f"{name} of the run in {run}" in verify(run).missing


def test_gaps_in_the_numbers_are_named_where_no_training_can_be_followed(run, messages, tmp_path):
    parts = by_episodes([m for m in messages if m.topic != PARAMETERS_TOPIC], 2, 4)
    bag = write(tmp_path / "copy", parts[::2])
    assert any("episodes 1.3 to 1.4" in text for text in verify(bag).missing)


def changed_headers(topic: str, change: Callable[[Any], Any]) -> Callable[[list[Message]], None]:
    """Changes the header of the last but two messages of a topic that are about an episode."""

    def apply(messages: list[Message]) -> None:
        at = [i for i, m in enumerate(messages) if m.topic == topic][-3 if topic != MODEL else -1]
        source = source_of(topic)
        assert source is not None and source.array is not None
        frame = change(source.codec.decode(messages[at].data))
        messages[at] = replace(messages[at], data=source.array.codec().encode(frame))

    return apply


def other_clock(messages: list[Message]) -> None:
    at = [i for i, m in enumerate(messages) if m.topic == "/clock"][5]
    data = clock_message(0.3125)
    assert data is not None
    messages[at] = replace(messages[at], data=data)


def no_clock(messages: list[Message]) -> None:
    del messages[[i for i, m in enumerate(messages) if m.topic == "/clock"][7]]


MODEL = "/model/identified"
HEADERS: dict[str, tuple[Callable[[list[Message]], None], str]] = {
    "a later state": (
        changed_headers("/state", lambda f: replace(f, time=np.nextafter(f.time, 9e9))),
        "times of the states and the cost of episode",
    ),
    "a later cost": (
        changed_headers("/episode/cost", lambda f: replace(f, time=f.time + 1e-9)),
        "times of the states and the cost of episode",
    ),
    "an earlier start": (
        changed_headers("/episode/start", lambda f: replace(f, time=f.time / 2)),
        "which no cost up to then has",
    ),
    "another policy, model and target": (
        changed_headers("/action", lambda f: replace(f, time=f.time + 1.0)),
        "signatures of the actions of episode",
    ),
    "an unsigned action": (
        changed_headers("/action", lambda f: replace(f, time=0.0)),
        "signatures of the actions of episode",
    ),
    "another start": (
        changed_headers("/episode/start", lambda f: replace(f, plant=f.plant + 1)),
        "signature of the start of episode",
    ),
    "another design": (
        changed_headers(MODEL, lambda f: replace(f, time=f.time + 1.0)),
        "signature of the model of episode",
    ),
    "another plant": (
        changed_headers("/state", lambda f: replace(f, plant=f.plant + 1)),
        "the fingerprints of several plants",
    ),
    "another clock": (other_clock, "/clock has the time 0.3125 s, which no state has"),
    "a clock less": (no_clock, "1 of the times on /clock, the first at"),
}


@pytest.mark.parametrize("name", HEADERS)
def test_times_signatures_and_the_clock_are_compared(messages, tmp_path, name):
    change, words = HEADERS[name]
    change(messages)
    report = verify(write(tmp_path / "bag", [messages]))
    assert not report.good
    assert words in words_of(report)


def test_an_episode_whose_times_are_all_later_is_a_difference(messages, tmp_path):
    """Its states follow each other as they must, but not the episode before."""
    for at, message in enumerate(messages):
        if episode_of(message) == PART + 4 and message.topic in ("/state", "/episode/cost"):
            source = source_of(message.topic)
            assert source is not None and source.array is not None
            frame = source.codec.decode(message.data)
            later = source.array.codec().encode(replace(frame, time=frame.time + 64.0))
            messages[at] = replace(message, data=later)
    text = words_of(verify(write(tmp_path / "bag", [messages])))
    assert "z_0 of episode 1.5 has the time" in text or "times of the states" in text
