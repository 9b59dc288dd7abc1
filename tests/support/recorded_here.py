# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A run and its bag, made in this process: the messages that the loop would have sent, in order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from controller_node.identification import DesignSettings, design_each
from pdeloop.bags.mcap_messages import Message
from pdeloop.bags.reader import Bag
from pdeloop.in_process import LocalPair
from pdeloop.messages.arrays import Array
from pdeloop.messages.documents import parse_yaml
from pdeloop.messages.frames import Frame
from pdeloop.messages.protocol import design_digest, digest_of, signature
from pdeloop.messages.samples import clock_message
from pdeloop.messages.topics import (
    ACTION,
    COMPLETED,
    COST,
    EPISODES_PER_START,
    MODEL,
    MODEL_IDENTIFIED,
    POLICY,
    START,
    STATE,
    TARGET,
    CostColumn,
    Topic,
)
from recorder_node.bag import FILE, METADATA, BagWriter, Channel
from recorder_node.recording import CLOCK, Recording, source_of, sources
from tests.support.small import parameters
from tuner_node.batch import Batch
from tuner_node.build import build_training
from tuner_node.run_store import open_run
from tuner_node.training import Training

MILLISECOND = 10**6
PART = EPISODES_PER_START + 1


class _Sent:
    """Gives every message the next millisecond, and records it."""

    def __init__(self, recording: Recording, run: int, plant: int) -> None:
        self._recording, self._run, self._plant = recording, run, plant
        self._sources = {source.array: source for source in sources("/") if source.array}
        self._when = 10**18
        self.time = 0.0
        """Simulated, of the messages to come."""

    def __call__(
        self,
        topic: Topic,
        episode: int,
        step: int,
        values: Array,
        *,
        time: float | None = None,
        plant: int | None = None,
    ) -> None:
        self._when += MILLISECOND
        time, plant = self.time if time is None else time, self._plant if plant is None else plant
        raw = topic.codec().encode(Frame(self._run, episode, step, time, values, plant))
        self._recording.take(self._sources[topic], self._when, raw)
        clock = clock_message(time) if topic is STATE else None
        if clock is not None:
            self._recording.take(CLOCK, self._when, clock)


def record_run(folder: Path, **options: Any) -> dict[str, Any]:
    """Train the small problem in the folder of a run with a bag; returns the parameters.

    An episode has at most four environments.
    """
    values = parameters(**{"seeds": 2, "iterations": 3, "evaluation_fields": 2, **options})
    values |= {"max_batch": 4, "out": str(folder), "resume": False}
    training, pair = build_training(values), LocalPair(values)
    with ExitStack() as locks:
        writer, identity = open_run(values, training, locks, print)
        assert writer is not None
        recording = Recording(folder / "bag", [*sources("/"), CLOCK])
        sent, episode = _Sent(recording, identity.run, pair.fingerprint), EPISODES_PER_START
        sent(TARGET, 0, 0, pair.plant.target)
        recording.note(identity.run, values)
        while (batch := training.next_batch()) is not None:
            if training.ready:
                pair.follow(training)
                assert training.models is not None
                sent(MODEL, 0, training.generation, training.models)
            for i in range(0, len(batch.rows), values["max_batch"]):
                episode += 1
                part = slice(i, i + values["max_batch"])
                policies = None if batch.policies is None else batch.policies[part]
                _send_episode(
                    sent, pair, Batch(batch.rows[part], policies, True), episode, training, values
                )
            for row in training.finish(pair.run(batch, values["max_batch"])):
                writer.note(row)
            writer.keep(now=0.0)
        recording.close()
        writer.finish({"transport": "in process"})
    return values


def _send_episode(
    sent: _Sent,
    pair: LocalPair,
    batch: Batch,
    episode: int,
    training: Training,
    values: dict[str, Any],
) -> None:
    generation = training.generation if training.ready else 0
    settings, signed = DesignSettings.of(values), [batch.rows]
    signed.append(np.asarray(settings.action_set.signed))
    if batch.policies is not None:
        assert training.models is not None
        sent(POLICY, episode, generation, batch.policies, plant=0)
        signed += [batch.policies, np.array(float(digest_of(training.models)))]
    digest = digest_of(*signed)
    sent(START, episode, generation, batch.rows, plant=digest)
    record, signature_of_actions = pair.roll_out(batch), signature(digest, pair.plant.target)
    for k, state in enumerate(record.states):
        sent.time += pair.plant.sample_time
        sent(STATE, episode, k, state)
        if k < len(record.actions):
            sent(ACTION, episode, k, record.actions[k], time=signature_of_actions)
    costs = record.costs.rows()
    sent(COST, episode, len(record.actions), costs)
    if batch.exploratory and (costs[:, CostColumn.ENDED] == COMPLETED).all():
        numbers = batch.rows[:, 3].astype(int).tolist()
        models = design_each(record.states, record.actions, numbers, pair.plant.target, settings)
        time = signature(digest, design_digest(asdict(settings)))
        sent(MODEL_IDENTIFIED, episode, len(record.actions), models, time=time)


def messages_of(bag: Path) -> list[Message]:
    return list(Bag(bag).messages())


def episode_of(message: Message) -> int:
    """The number of the episode that a message is about; 0 if it is about none."""
    source = source_of(message.topic)
    if source is None or source.array in (None, TARGET, MODEL):
        return 0
    return source.codec.decode(message.data).episode


def write(folder: Path, parts: Sequence[Sequence[Message]]) -> Path:
    """A bag of these messages, one file for each part, with the metadata that rosbag2 would write."""
    folder.mkdir(parents=True)
    told: list[dict[str, Any]] = []
    for number, messages in enumerate(parts):
        writer = BagWriter(folder / "part", [Channel(*t) for t in _topics(parts)])
        for message in messages:
            writer.write(message.topic, message.when, message.data)
        writer.close()
        name = FILE if len(parts) == 1 else f"bag_{number}.mcap"
        (folder / "part" / FILE).rename(folder / name)
        text = (folder / "part" / METADATA).read_text()
        told.append(parse_yaml(text.encode())["rosbag2_bagfile_information"])
        told[-1]["files"][0]["path"] = name
        told[-1]["relative_file_paths"] = [name]
        (folder / "part" / METADATA).unlink()
        (folder / "part").rmdir()
    write_metadata(folder, _together(told))
    return folder


def _topics(parts: Sequence[Sequence[Message]]) -> dict[tuple[str, str], None]:
    return {(message.topic, message.type): None for part in parts for message in part}


def _together(told: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The metadata of a bag in several files, from that of each."""
    files = [entry for one in told for entry in one["files"]]
    first = [entry["starting_time"]["nanoseconds_since_epoch"] for entry in files]
    last = [f + entry["duration"]["nanoseconds"] for f, entry in zip(first, files, strict=True)]
    counts = np.array([[t["message_count"] for t in m["topics_with_message_count"]] for m in told])
    topics = [dict(topic) for topic in told[0]["topics_with_message_count"]]
    for topic, count in zip(topics, counts.sum(axis=0).tolist(), strict=True):
        topic["message_count"] = count
    return told[0] | {
        "files": files,
        "relative_file_paths": [entry["path"] for entry in files],
        "starting_time": {"nanoseconds_since_epoch": min(first)},
        "duration": {"nanoseconds": max(last) - min(first)},
        "message_count": sum(entry["message_count"] for entry in files),
        "topics_with_message_count": topics,
    }


def read_metadata(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = parse_yaml((folder / METADATA).read_bytes())
    return dict(content["rosbag2_bagfile_information"])


def write_metadata(folder: Path, content: dict[str, Any]) -> None:
    text = yaml.safe_dump({"rosbag2_bagfile_information": content}, sort_keys=False)
    (folder / METADATA).write_text(text)


def change_metadata(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Write the metadata of a bag as `change` leaves it."""
    content = read_metadata(folder)
    change(content)
    write_metadata(folder, content)
