# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A dispatcher of a few pairs, and what plants and controllers answer it."""

from __future__ import annotations

import numpy as np

from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import COMPLETED, START, VOID
from tests.support.small import dispatcher_of
from tuner_node.batch import Batch
from tuner_node.dispatch import Dispatcher

RUN = 42
EXPLORATION = Batch(np.array([[3.0, 4.0, 0.1, 0.0]]), None)


def dispatcher(pairs: int = 1, **settings) -> Dispatcher:
    made = dispatcher_of(
        **({"run": RUN, "pairs": pairs, "max_batch": 4, "incarnation": 1} | settings)
    )
    for pair in range(pairs):
        made.presence(pair, (), 0.0)
    return made


def batch(count: int) -> Batch:
    rows = np.column_stack(
        [np.arange(count), np.full(count, -1), np.zeros(count), np.zeros(count)]
    ).astype(float)
    return Batch(rows, np.arange(count, dtype=float)[:, None, None] * np.ones((1, 2, 4)))


def starts(publications):
    return [(pair, send.frame) for pair, send in publications if send.topic is START]


def costs_of(frame: Frame) -> Frame:
    """What a plant answers here: a cost that tells which row it belongs to."""
    values = np.column_stack(
        [frame.values[:, 0] ** 2, frame.values[:, 0], np.full(len(frame.values), COMPLETED)]
    )
    return Frame(frame.run, frame.episode, 30, 1.0, values.astype(float))


def void_of(frame: Frame) -> Frame:
    values = np.tile([0.0, 0.0, VOID], (len(frame.values), 1))
    return Frame(frame.run, frame.episode, 3, 1.0, values)


def model_of(frame: Frame, gain: float = 1.0, plant: int = 0) -> Frame:
    return Frame(RUN, frame.episode, 0, 1.0, np.full((1, 9, 2), gain), plant)
