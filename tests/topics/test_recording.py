# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Recording real loops: nothing is missed, and everything can be recomputed."""

from __future__ import annotations

import shutil
import signal
import struct
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from pdeloop.bags.mcap_messages import files
from pdeloop.bags.reader import Bag
from pdeloop.bags.verify import verify
from pdeloop.identification import identify_bag
from pdeloop.messages.frames import Frame
from pdeloop.messages.model_rows import pack
from recorder_node.bag import BagWriter, Channel
from recorder_node.recording import PARAMETERS_TOPIC
from tests.support.loop_harness import until
from tests.support.operator_harness import operator
from tests.support.recorded_here import messages_of, write
from tests.support.small import RECORDED, SMALL, paced, same_bits
from tests.support.small_loop import (
    LIMIT,
    adapted,
    assert_same_training,
    in_process,
    tuner_arguments,
)

pytestmark = pytest.mark.topics
STEPS, ITERATIONS = 30, int(RECORDED["iterations"])
EPISODES = ITERATIONS + 3  # exploration, check, the iterations, evaluation


def test_a_recorded_run_is_complete_and_everything_in_it_is_recomputed(recorded):
    assert_same_training(recorded, in_process(iterations=ITERATIONS, seeds=2))
    report = verify(recorded)
    assert (report.count, report.missing) == (0, [])
    assert (report.incomplete, report.notes) == ([], [])
    assert report.episodes == EPISODES
    assert report.compared["policies"] == report.compared["costs"] - 2
    assert report.compared["steps"] == report.compared["costs"] * STEPS
    episodes = list(Bag(recorded).episodes())
    assert [episode.missing for episode in episodes] == [[]] * EPISODES
    found = {topic: set() for topic in ("/state", "/clock")}  # a busy plant may repeat a state
    for message in Bag(recorded).messages():
        found.setdefault(message.topic, set()).add(message.data)
    assert len(found["/state"]) == EPISODES * (STEPS + 1)
    assert len(found["/clock"]) >= EPISODES * STEPS
    with AnyReader([recorded / "bag"]) as reader:
        told = [c for c in reader.connections if c.topic in ("/diagnostics", "/rosout")]
        messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(told)]
    names = {status.name for m in messages if hasattr(m, "status") for status in m.status}
    assert names >= {"pde_sim_node: lock-step", "recorder_node: recording"}
    assert {"pde_sim_node", "tuner_node"} <= {m.name for m in messages if hasattr(m, "msg")}


def rewrite(bag: Path, frame: Frame, number: int = 0) -> None:
    """Change the last bit of the number at this place of `frame`, where it is in the bag."""
    messages = list(Bag(bag).messages())
    (bag / "bag.mcap").rename(bag / "old")
    topics = {message.topic: message.type for message in messages}
    writer = BagWriter(bag / "again", [Channel(*topic) for topic in topics.items()])
    ids, values = struct.pack("<3d", frame.run, frame.episode, frame.step), frame.values.tobytes()
    changed = 0
    for message in messages:
        data, place = bytearray(message.data), message.data.find(values)
        if place > 0 and data[place - 40 : place - 16] == ids:
            data[place + 8 * number] ^= 1
            changed += 1
        writer.write(message.topic, message.when, bytes(data))
    writer.close()
    assert changed  # more than one where a message was sent again
    (bag / "again" / "bag.mcap").rename(bag / "bag.mcap")


@pytest.mark.parametrize("topic", ["state", "action", "policy", "cost", "model", "models", "start"])
def test_verify_finds_a_single_bit_that_was_changed(recorded, tmp_path, topic):
    copy = tmp_path / "bag"
    shutil.copytree(recorded / "bag", copy)
    episodes = list(Bag(copy).episodes())
    exploratory, adapting = episodes[0], episodes[4]
    of_A = np.size(Bag(copy).target()) * exploratory.model.values.shape[2]  # after U; no law uses A
    frame, words = {
        "state": (adapting.states[17], f"z_17 of episode {adapting.name}"),
        "action": (adapting.actions[12], f"a_12 of episode {adapting.name}"),
        "policy": (adapting.policy, f"policy of episode {adapting.name}"),
        "cost": (adapting.cost, f"cost of episode {adapting.name}"),
        "model": (exploratory.model, f"model of episode {exploratory.name}"),
        "models": (adapting.bases, f"models number {adapting.bases.step} of run"),
        "start": (adapting.start, f"of episode {adapting.name}"),
    }[topic]
    rewrite(copy, frame, of_A if topic == "models" else 0)
    report = verify(copy)
    assert report.count > 0
    assert any(words in text for text in report.differences), report.text()


def test_the_command_line_informs_verifies_and_identifies(loop, recorded, tmp_path):
    text = loop.wait(loop.pdeloop("bag", "info", str(recorded)), LIMIT)
    assert f"{EPISODES} episodes, 1 of them exploratory, 0 incomplete" in text
    assert "/state" in text
    text = loop.wait(loop.pdeloop("bag", "verify", str(recorded)), LIMIT)
    assert "no difference, to the bit" in text
    out = tmp_path / "model.npz"
    text = loop.wait(
        loop.pdeloop(
            "identify",
            "--bag",
            str(recorded),
            "--environment",
            "1",
            "--order",
            "4",
            "--out",
            str(out),
        ),
        LIMIT,
    )
    assert "reduced model of order 4" in text
    with np.load(out) as saved, np.load(recorded / "policy.npz") as live:
        assert same_bits(saved["model"][0], live["model"][1])


def test_identify_from_a_bag_equals_the_live_model(recorded):
    with np.load(recorded / "policy.npz") as live:
        for seed in (0, 1):
            found = identify_bag(recorded / "bag", {}, environment=seed)
            assert same_bits(pack(found.model), live["model"][seed])
    both = identify_bag(recorded / "bag", {"reduced_order": 4})
    assert both.steps == 2 * STEPS


def test_identify_needs_nothing_but_the_topics_of_a_foreign_plant(recorded, tmp_path):
    own = [m for m in messages_of(recorded / "bag") if m.topic != PARAMETERS_TOPIC]
    copy = write(tmp_path / "bag", [own])
    found = identify_bag(copy, {"reduced_order": 4, "identification": "regression"}, environment=0)
    with np.load(recorded / "policy.npz") as live:
        assert same_bits(pack(found.model), live["model"][0])
    suggested = identify_bag(copy, {})  # the bag does not say which order it had
    assert suggested.study is not None
    assert suggested.model.A.shape[0] == suggested.study.suggested
    report = verify(copy)
    assert "its parameters are not in the bag" in report.notes[0]
    assert verify(copy, parameters=recorded / "parameters.yaml").count == 0


def test_a_second_recording_of_a_run_gets_a_bag_of_its_own(loop, tmp_path):
    out, iterations = tmp_path / "run", 40
    words = ("train", str(paced(tmp_path, 10.0)), "--iterations", str(iterations))
    run = loop.pdeloop(*words, "--out", str(out), "--record")
    until(lambda: adapted(out) >= 5, LIMIT, "iteration 5")
    run.send_signal(signal.SIGHUP)  # as a terminal that is closed does
    loop.wait(run, LIMIT, code=130)
    assert files(out / "bag") and Bag(out / "bag").finished
    loop.wait(loop.pdeloop("train", "--resume", str(out), "--record"), LIMIT)
    assert_same_training(out, in_process(iterations=iterations))
    second = verify(out / "bag-2")
    assert (second.count, second.missing, second.notes) == (0, [], []), second.text()
    both = verify(out)
    assert (both.count, both.missing, both.notes) == (0, [], []), both.text()
    assert len(both.incomplete) <= 1  # the one that the signal cut short
    assert (
        both.compared["policies"] == 2 + 2 * iterations + 30 + 1
    )  # the first is repeated at the end


def test_one_recorder_records_several_pairs(loop, tmp_path):
    for pair in ("a", "b"):
        where = ("-r", f"__ns:=/{pair}", "--params-file", str(SMALL))
        loop.node("pde_sim_node", *where, "-p", "publish_clock:=false")
        loop.node("controller_node", *where)
    pairs = ("-p", "pairs:=['a','b']")
    with operator(loop) as desk:
        tuner = loop.node(
            "tuner_node",
            "--params-file",
            str(SMALL),
            "-p",
            "recorder:=start",
            *pairs,
            *tuner_arguments(tmp_path / "run", seeds=2, max_batch=3),
        )
        lacking = "recorder of pair 0 and recorder of pair 1"  # both pairs are there
        until(lambda: desk.values("tuner_node").get("waiting for") == lacking, LIMIT, "pairs known")
    recorder = loop.node("recorder_node", "-p", f"bag:={tmp_path / 'bag'}", *pairs)
    loop.wait(tuner, LIMIT)
    recorder.send_signal(signal.SIGINT)
    loop.wait(recorder, LIMIT)
    assert_same_training(tmp_path / "run", in_process(seeds=2))
    report = verify(tmp_path / "bag")
    assert (report.count, report.incomplete, report.notes) == (0, [], []), report.text()
    assert {e.key[0] for e in Bag(tmp_path / "bag").episodes()} == {"/a", "/b"}
