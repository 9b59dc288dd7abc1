# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A bag of every n-th state: what is in it is verified to the bit, and nothing else is missed."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pdeloop.bags.info import describe, info_text
from pdeloop.bags.verify import verify
from pdeloop.identification import identify_bag
from pdeloop.messages.frames import ArrayCodec
from pdeloop.messages.spec import ParameterError
from pdeloop.messages.topics import STATE
from pdeloop.pairs import Transport
from recorder_node.bag import BagError
from recorder_node.recording import (
    CLOCK,
    PARAMETERS_TOPIC,
    Recording,
    large_bag,
    source_of,
    sources,
)
from tests.support.recorded_here import messages_of, record_run

EVERY = 4


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run; its bag has every fourth state."""
    folder = tmp_path_factory.mktemp("run") / "run"
    values = record_run(folder, iterations=1, seeds=1, evaluation_fields=1)
    record_again(folder, {name: value for name, value in values.items() if name != "out"})
    return folder


def record_again(folder: Path, values: dict, changed: int = -1) -> None:
    """The run's bag with every fourth state; changed: a state of this step is another one."""
    messages = messages_of(folder / "bag")
    shutil.rmtree(folder / "bag")
    recording, number = Recording(folder / "bag", [*sources("/"), CLOCK], EVERY), 0
    for message in messages:
        if message.topic == PARAMETERS_TOPIC:
            continue
        if message.topic == CLOCK.channel.topic:
            recording.take(CLOCK, message.when, message.data)
            continue
        source, data = source_of(message.topic), message.data
        assert source is not None
        number = source.codec.decode(data).run or number
        if source.array is STATE and source.codec.decode(data).step == changed:
            data = altered(source.codec, data)
            changed = -1
        recording.take(source, message.when, data)
    recording.note(number, values)
    recording.close()


def altered(codec: ArrayCodec, data: bytes) -> bytes:
    frame = codec.decode(data)
    return codec.encode(
        type(frame)(
            frame.run, frame.episode, frame.step, frame.time, frame.values + 1e-12, frame.plant
        )
    )


def test_what_is_recorded_is_verified_and_nothing_else_is_missed(run: Path) -> None:
    report = verify(run)
    assert report.good and not (report.incomplete or report.notes), report.text()
    (episode, *_), steps = describe(run / "bag")["episodes"], 0
    assert not episode["missing"] and episode["state_every"] == EVERY
    for message in messages_of(run / "bag"):
        source = source_of(message.topic)
        if source is not None and source.array is STATE:
            step = source.codec.decode(message.data).step
            assert step % EVERY == 0
            steps += 1
    assert steps == report.episodes * len(range(0, 31, EVERY))
    assert f"a state every {EVERY} steps" in info_text(describe(run / "bag"))


def test_a_recorded_state_that_is_another_one_is_a_difference(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    record_again(folder, {}, changed=2 * EVERY)
    text = verify(folder).text()
    assert f"z_{2 * EVERY} of episode" in text


def test_no_model_is_identified_from_a_part_of_the_states(run: Path) -> None:
    with pytest.raises(BagError, match="every 4 steps only"):
        identify_bag(run / "bag", {})


def test_a_large_bag_is_announced_with_what_makes_it_smaller() -> None:
    values = {"n_z": 65_536, "horizon": 99, "rollouts": 20, "evaluation_fields": 10}
    assert "about 2.6 GB" in large_bag(values)  # (20 + 3 * 10) * 100 * 65,536 * 8 bytes
    assert large_bag(values, 10) == ""


def test_a_rate_without_a_recording_and_a_rate_of_nothing_are_refused() -> None:
    with pytest.raises(ParameterError, match="--record as well"):
        Transport(record_every=2)
    with pytest.raises(ParameterError, match="'state_every' is 0"):
        Transport(recorder="start", record_every=0)
    assert Transport(recorder="start", record_every=2).record_every == 2
