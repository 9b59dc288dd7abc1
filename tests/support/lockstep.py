# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The protocol of a small plant, and messages to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pde_sim_node.build import build_plant
from pde_sim_node.lockstep import Lockstep
from pde_sim_node.real_time import Timing
from pdeloop.messages.frames import Frame
from pdeloop.messages.protocol import Publication
from pdeloop.messages.topics import COST, STATE, VOID, CostColumn
from tests.support.small import parameters

RUN = 11
PLANT = 77
SEEDS = (3, 4)


def plant_protocol(paused: bool = False, signed_run: int = 0, **overrides) -> Lockstep:
    values = parameters(**overrides)
    return Lockstep(
        build_plant(values),
        Timing(action_timeout=0.1, max_repeats=3, run_hold=10.0),
        fingerprint=PLANT,
        paused=paused,
        signed_run=signed_run,
    )


def start(episode: int, seeds=SEEDS, run: int = RUN) -> Frame:
    rows = np.array([(seed, -1.0, 0.0, 0.0) for seed in seeds], dtype=float).reshape(-1, 4)
    return Frame(run, episode, 0, 0.0, rows)


def answer(state: Frame, scale: float = 0.1) -> Frame:
    actions = scale * state.values[:, :4]
    return replace(state, values=actions)


def kept(frame: Frame) -> Frame:
    """The frame for later: the plant writes its next state into the same memory."""
    return replace(frame, values=frame.values.copy())


def is_void(send: Publication) -> bool:
    return send.topic is COST and bool((send.frame.values[:, CostColumn.ENDED] == VOID).all())


def run_episode(protocol: Lockstep, episode: int, now: float = 0.0, disturb=None) -> list[Frame]:
    """All frames of an episode; `disturb(protocol, state, now)` may interfere before each answer."""
    (send,) = protocol.start(start(episode), now)
    frames = [kept(send.frame)]
    while send.topic is STATE:
        now += 0.01
        if disturb:
            disturb(protocol, send.frame, now)
        (send,) = protocol.action(answer(send.frame), now)
        frames.append(kept(send.frame))
    assert send.topic is COST
    return frames


def outcome(frames: list[Frame]) -> bytes:
    return b"".join(frame.values.tobytes() for frame in frames)
