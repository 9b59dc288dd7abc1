# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A controller and a plant with their fast paths, and messages to them as bytes."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from controller_node.fast_path import ControllerFastPath
from controller_node.identification import DesignSettings
from controller_node.responder import Responder
from pde_sim_node.fast_path import PlantFastPath
from pdeloop.messages import model_rows
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.frames import HEADER, ArrayCodec, Frame
from pdeloop.messages.topics import ACTION, STATE
from tests.support.lockstep import PLANT, RUN, plant_protocol

N_Z, N_S, N_A = 37, 5, 3
RNG = np.random.default_rng(0)


def with_number(raw: bytes, values: int, place: int, number: float) -> bytes:
    """A message of so many values with another number, counted from the header or from the end."""
    at = len(raw) + 8 * (place - HEADER - values if place >= 0 else place)
    return raw[:at] + struct.pack("<d", number) + raw[at + 8 :]


@contextmanager
def armed(path: Any, now: float = 0.0) -> Iterator[Any]:
    """As while the node's thread waits: a function from a message to its answer, or to None.

    now: when it ends.
    """
    kind = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_ssize_t)
    handle, prepared, count = kind(path.handle), path.prepare(), 0

    def answer(raw: bytes) -> bytes | None:
        nonlocal count
        if not prepared or not handle(path.plans.ctypes.data, raw, len(raw)):
            return None
        count += 1
        return bytes(path.answer.raw)

    yield answer
    if prepared:
        path.synchronise(count, now)


def fast(path: Any, raw: bytes, now: float = 0.0) -> bytes | None:
    """The answer to one message on the fast path; None: it goes the ordinary way."""
    with armed(path, now) as answer:
        found: bytes | None = answer(raw)
        return found


class Controller:
    """A responder in the middle of an episode, with its fast path and the codecs of its peer."""

    def __init__(self, batch: int, *, limit: float = 0.0) -> None:
        self.settings = DesignSettings(
            n_a=N_A,
            reduced_order=N_S,
            state_weight=1.0,
            action_weight=1.0,
            action_set=ActionSet(limit=limit),
        )
        self.batch = batch
        self.responder, self.judge = Responder(self.settings), Responder(self.settings)
        models = []
        for _ in range(2):
            U = np.linalg.qr(RNG.standard_normal((N_Z, N_S)))[0]
            models.append(
                model_rows.pack(
                    model_rows.ModelRows(
                        A=np.zeros((N_S, N_S)),
                        B=np.zeros((N_S, N_A)),
                        U=U,
                        K_a=np.zeros((N_A, N_S)),
                        K_b=np.zeros((N_A, N_S)),
                        s_r=np.zeros(N_S),
                    )
                )
            )
        for responder in (self.responder, self.judge):
            responder.target(Frame(0, 0, 0, 0.0, np.cos(np.arange(N_Z)), PLANT))
            responder.model(Frame(RUN, 0, 0, 0.0, np.stack(models)))
        self.peer, self.own, self.sent = (
            ArrayCodec(STATE.labels),
            ArrayCodec(STATE.labels),
            ArrayCodec(ACTION.labels),
        )
        self.path = ControllerFastPath(self.responder, self.own)

    def begin(self, episode: int) -> None:
        rows = np.zeros((self.batch, 4))
        rows[:, 1], rows[:, 3] = -1, np.arange(self.batch) % 2
        policies = RNG.standard_normal((self.batch, N_A, 2 * N_S))
        for responder in (self.responder, self.judge):
            responder.policy(Frame(RUN, episode, 0, 0.0, policies))
            # In every other episode the actions are to be signed.
            responder.start(Frame(RUN, episode, 0, 0.0, rows, 123 * (episode % 2)))

    def state(self, episode: int, step: int, run: int = RUN) -> bytes:
        values = RNG.standard_normal((self.batch, N_Z))
        return self.peer.encode(Frame(run, episode, step, 0.1 * step, values, PLANT))

    def ordinary(self, raw: bytes) -> bytes:
        frame = self.own.decode(raw)
        (send,) = self.responder.state(frame)
        self.path.last_state = frame
        return self.sent.encode(send.frame)

    def expected(self, raw: bytes) -> bytes:
        (send,) = self.judge.state(ArrayCodec(STATE.labels).decode(raw))
        return self.sent.encode(send.frame)


class NoSamples:
    """Nobody records or looks."""

    timed = False

    def reserve(self, records: Any, room: int) -> None:
        records["open"] = 0

    def commit(self, records: Any, sizes: Any, count: int) -> None:
        pass


class Plant:
    """A lock-step with its fast path, and one that only goes the ordinary way."""

    def __init__(self, batcher: Any = None, **overrides: object) -> None:
        self.now = 0.0
        self.lockstep, self.judge = (plant_protocol(**overrides) for _ in range(2))
        self.peer, self.own, self.sent = (
            ArrayCodec(ACTION.labels),
            ArrayCodec(ACTION.labels),
            ArrayCodec(STATE.labels),
        )
        self.path = PlantFastPath(self.lockstep, self.own, batcher or NoSamples())

    def begin(self, episode: int, seeds: tuple[int, ...], told: int = 0) -> Frame:
        rows = np.zeros((len(seeds), 4))
        rows[:, 0], rows[:, 1] = seeds, -1
        for lockstep in (self.lockstep, self.judge):
            *_, send = lockstep.start(Frame(RUN, episode, 0, 0.0, rows, told), self.now)
        return send.frame

    def action(self, state: Frame) -> bytes:
        values = 0.1 * RNG.standard_normal((len(state.values), 4))
        return self.peer.encode(replace(state, values=values))

    def ordinary(self, raw: bytes) -> Frame:
        (send,) = self.lockstep.action(self.own.decode(raw), self.now)
        return send.frame

    def expected(self, raw: bytes) -> tuple[object, Frame]:
        (send,) = self.judge.action(ArrayCodec(ACTION.labels).decode(raw), self.now)
        return send.topic, send.frame
