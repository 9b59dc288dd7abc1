# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A bag of two short episodes, written without a loop, and what a killed recorder leaves of it."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import ACTION, COST, START, STATE
from recorder_node.recording import CLOCK, Recording, sources

RUN = 2**52 + 1
SECOND = 10**9
MESSAGES = 1 + 2 * (1 + 6 + 6 + 1) + 1
"""Of the bag `written`: a time, two episodes, the parameters of the run."""
WHAT = [*sources("/left"), CLOCK]
BY_TOPIC = {source.array: source for source in WHAT if source.array}


def frame(step: int, *shape: int, episode: int = 7) -> Frame:
    values = np.random.default_rng([step, *shape]).standard_normal(shape)
    return Frame(RUN, episode, step, 0.25 * step, values, 99)


def encode(topic, content: Frame) -> bytes:
    return topic.codec().encode(content)


def recorded_episode(
    recording: Recording,
    episode: int = 7,
    steps: int = 5,
    skip: int = -1,
    cost: Mapping[str, Any] = {},
) -> None:
    """An episode as the loop would send it, a message a millisecond."""
    when = episode * SECOND

    def take(topic, content: Frame) -> None:
        nonlocal when
        when += SECOND // 1000
        recording.take(BY_TOPIC[topic], when, encode(topic, content))

    rows = np.array([(3.0, 4.0, 0.1, 0.0)])
    take(START, Frame(RUN, episode, 0, 0.0, rows))
    for step in range(steps + 1):
        if step != skip:
            take(STATE, frame(step, 1, 16, episode=episode))
        take(ACTION, frame(step, 1, 4, episode=episode))
    usual = Frame(RUN, episode, steps, 0.0, np.array([(1.0, 5.0, -1.0)]), 99)
    take(COST, replace(usual, **cost))


def written(folder: Path, **how: int) -> Path:
    path = folder / "bag"
    recording = Recording(path, WHAT)
    recording.take(WHAT[-1], SECOND, bytes.fromhex("00010000") + bytes(8))
    for episode in (7, 8):
        recorded_episode(recording, episode, **how)
    recording.note(RUN, {"n_z": 16})
    recording.close()
    return path


def killed(bag: Path) -> Path:
    """What a recorder that is killed now leaves behind."""
    copy = bag.with_name("killed")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(bag, copy)
    return copy
