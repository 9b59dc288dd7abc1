# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fast path from bytes to bytes: the same bytes as the ordinary one, and only where it may."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from controller_node.fast_path import ControllerFastPath
from controller_node.identification import DesignSettings
from controller_node.responder import Responder
from loop_interfaces import model_rows
from loop_interfaces.frames import HEADER, ArrayCodec, Frame, FrameError
from loop_interfaces.signature import signature
from loop_interfaces.topics import ACTION, COMPLETED, COST, STATE, VOID
from pde_sim_node.fast_path import PlantFastPath
from tests.support.lockstep import PLANT, RUN, is_void, plant_protocol

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
            action_limit=limit,
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


@pytest.mark.parametrize("batch", [1, 2, 4, 7, 64])
@pytest.mark.parametrize("limit", [0.0, 0.5])
def test_a_controller_answers_with_the_same_bytes(batch: int, limit: float) -> None:
    controller = Controller(batch, limit=limit)
    for episode in (4, 5, 9):
        controller.begin(episode)
        first = controller.state(episode, 0)
        assert fast(controller.path, first) is None
        assert controller.ordinary(first) == controller.expected(first)
        for step in range(1, 6):
            raw = controller.state(episode, step)
            with armed(controller.path) as answer:
                assert answer(raw) == answer(raw) == controller.expected(raw)
    if limit:
        found = fast(controller.path, raw)
        assert found is not None
        assert abs(ArrayCodec(ACTION.labels).decode(found).values).max() == limit


def test_a_controller_leaves_everything_else_to_the_responder() -> None:
    controller = Controller(3)
    controller.begin(4)
    good = controller.state(4, 1)
    controller.ordinary(controller.state(4, 0))
    assert fast(controller.path, good)
    RUN_AT, EPISODE_AT, STEP_AT, TIME_AT, PLANT_AT = range(HEADER)
    for place, number in (
        (RUN_AT, RUN + 1.0),
        (EPISODE_AT, 5.0),
        (PLANT_AT, PLANT + 1.0),
        (STEP_AT, 1.5),
        (STEP_AT, -1.0),
        (STEP_AT, 2.0**53),
        (STEP_AT, np.nan),
        (TIME_AT, np.inf),
        (HEADER, np.nan),
        (HEADER + 50, np.inf),
        (HEADER + 50, -np.inf),
        (-1, np.nan),
    ):
        assert fast(controller.path, with_number(good, 3 * N_Z, place, number)) is None, place
    others = Controller(4)
    for raw in (b"", good[:-8], good + bytes(8), good[:4], others.state(4, 1)):
        assert fast(controller.path, raw) is None
    # Padding of ordinary message objects is undefined; the labels themselves are not.
    assert fast(controller.path, good.replace(b"env", b"enw", 1)) is None
    assert fast(controller.path, good)


@pytest.mark.parametrize("furthest, says", [(6, 1), (7, 0)])
def test_the_furthest_of_two_plants_is_remembered_though_the_other_was_answered_last(
    furthest: int, says: int
) -> None:
    controller = Controller(1)
    controller.begin(4)
    controller.ordinary(controller.state(4, 0))
    with armed(controller.path) as answer:
        assert all(answer(controller.state(4, step)) for step in (1, 2, furthest, 3))
    assert controller.responder.step == 3
    cost, void = (
        Frame(RUN, 4, step, 0.1, np.array([[1.0, 7.0, ended]]), PLANT)
        for step, ended in ((7, COMPLETED), (3, VOID))
    )
    assert controller.responder.cost(cost) == []
    assert len(controller.responder.cost(void)) == says


def test_a_responder_knows_what_was_answered_and_what_it_was_told_since_counts() -> None:
    controller = Controller(2)
    controller.begin(4)
    controller.ordinary(controller.state(4, 0))
    with armed(controller.path) as answer:
        assert all(answer(controller.state(4, step)) for step in range(1, 8))
        assert (controller.responder.answered, controller.responder.step) == (1, 0)
    assert (controller.responder.answered, controller.responder.step) == (8, 7)
    # A state of another episode that waits is dropped with the next answer.
    assert controller.responder.state(controller.own.decode(controller.state(5, 0))) == []
    assert fast(controller.path, raw := controller.state(4, 8)) is None
    assert controller.ordinary(raw) == controller.expected(raw)
    assert controller.responder.waits_for() == []
    # A state that waits for its policy has to be answered first, and new policies taken.
    controller.begin(5)
    controller.ordinary(controller.state(5, 0))
    controller.responder.start(Frame(RUN, 6, 0, 0.0, np.array([[0.0, -1.0, 0.0, 0.0]] * 2)))
    assert fast(controller.path, controller.state(5, 1)) is None
    controller.begin(7)
    controller.ordinary(controller.state(7, 0))
    assert fast(controller.path, raw := controller.state(7, 1)) == controller.expected(raw)
    with pytest.raises(FrameError, match="two different policies"):
        controller.responder.policy(Frame(RUN, 7, 0, 0.0, np.zeros((2, N_A, 2 * N_S))))
    assert fast(controller.path, controller.state(7, 2)) is None
    # A new target changes the law; the first state after it prepares that.
    controller.begin(8)
    controller.ordinary(controller.state(8, 0))
    for responder in (controller.responder, controller.judge):
        responder.target(Frame(0, 0, 0, 0.0, np.sin(np.arange(N_Z)), PLANT))
    assert fast(controller.path, raw := controller.state(8, 1)) is None
    assert controller.ordinary(raw) == controller.expected(raw)
    assert fast(controller.path, raw := controller.state(8, 2)) == controller.expected(raw)
    # Where the controller explores there is no law.
    rows = np.array([[0.0, 3.0, 0.1, 0.0]] * 2)
    controller.responder.start(Frame(RUN, 9, 0, 0.0, rows))
    controller.ordinary(controller.state(9, 0))
    assert fast(controller.path, controller.state(9, 1)) is None
    assert controller.responder.answered == 16


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


@pytest.mark.parametrize("overrides", [{}, {"horizon": 12, "n_z": 48}])
@pytest.mark.parametrize("at_once", [1, 3])
def test_a_plant_goes_on_with_the_same_bytes(overrides: dict, at_once: int) -> None:
    """at_once: actions between two looks of the lock-step."""
    plant = Plant(**overrides)
    for episode, seeds in ((1, (3, 4)), (2, (5, 6)), (7, (1, 2, 3)), (8, (1, 2, 3))):
        state = plant.begin(episode, seeds)
        taken = 0
        while plant.lockstep.active:
            plant.now += 0.01
            with armed(plant.path, plant.now) as answer:
                for _ in range(at_once):
                    raw = plant.action(state)
                    topic, expected = plant.expected(raw)
                    found = answer(raw)
                    if found is None:
                        break
                    taken += 1
                    assert found == plant.sent.encode(expected)
                    state = expected
            if found is None:
                sent = plant.ordinary(raw)
                assert sent.values.tobytes() == expected.values.tobytes()
                state = expected
            else:
                last = plant.lockstep.last_state
                assert last is not None
                assert plant.sent.encode(last) == found
        assert topic is COST
        # All but the last, and the first from a peer that has not sent such an action before.
        assert taken == plant.lockstep.plant.horizon - (episode in (1, 7))
    assert plant.lockstep.counters == plant.judge.counters
    assert (plant.lockstep.steps_total, plant.lockstep.rounds_total, plant.lockstep.time) == (
        plant.judge.steps_total,
        plant.judge.rounds_total,
        plant.judge.time,
    )


def test_a_plant_leaves_everything_else_to_the_lockstep() -> None:
    plant = Plant()
    state = plant.begin(1, (3, 4))
    assert fast(plant.path, plant.action(state)) is None
    state = plant.ordinary(plant.action(state))
    good = plant.action(state)
    RUN_AT, EPISODE_AT, STEP_AT, TIME_AT, PLANT_AT = range(HEADER)
    for place, number in (
        (RUN_AT, RUN + 1.0),
        (EPISODE_AT, 2.0),
        (PLANT_AT, PLANT + 1.0),
        (STEP_AT, 0.0),
        (STEP_AT, 2.0),
        (TIME_AT, np.nan),
        (HEADER, np.nan),
        (-1, np.inf),
    ):
        assert fast(plant.path, with_number(good, 8, place, number)) is None, (place, number)
    for raw in (b"", good[:-8], good + bytes(8)):
        assert fast(plant.path, raw) is None
    assert plant.lockstep.step == 1
    plant.lockstep.pause(0.0)
    assert fast(plant.path, good) is None
    plant.lockstep.resume(0.0)
    plant.path.suspended = True
    assert fast(plant.path, good) is None
    plant.path.suspended = False
    with armed(plant.path) as answer:
        first = answer(good)
        assert first is not None
        assert answer(good) is None  # a duplicate of what was taken
    assert plant.lockstep.step == 2

    # Strangers change nothing of what is awaited: another plant, run, episode or shape.
    state = ArrayCodec(STATE.labels).decode(first)
    strangers = (
        replace(state, plant=PLANT + 1),
        replace(state, run=RUN + 1),
        replace(state, episode=2),
        replace(state, plant=PLANT + 1, values=state.values[:1]),
    )
    for stranger in strangers:
        raw = plant.peer.encode(replace(stranger, values=np.full((len(stranger.values), 4), 0.5)))
        assert plant.lockstep.action(plant.own.decode(raw), 0.0) == []
        assert fast(plant.path, raw) is None
    assert plant.lockstep.step == 2
    plant.ordinary(plant.action(state))
    assert plant.lockstep.step == 3

    # Nothing of an episode is taken for one of the next.
    plant.begin(2, (5, 6))
    late = with_number(good, 8, STEP_AT, 0.0)
    assert fast(plant.path, late) is None
    assert plant.lockstep.step == 0


def test_a_plant_takes_only_actions_with_the_signature_of_their_episode() -> None:
    plant = Plant()
    for episode, told in ((1, 8), (2, 9)):
        state = plant.begin(episode, (3, 4), told)
        time = signature(told, plant.lockstep.plant.target)
        state = plant.ordinary(plant.action(replace(state, time=time)))
        for wrong in (state.time, 0.0, signature(10, plant.lockstep.plant.target)):
            raw = plant.action(replace(state, time=wrong))
            assert fast(plant.path, raw) is None
            with pytest.raises(FrameError, match="not computed from the policy"):
                plant.lockstep.action(plant.own.decode(raw), 0.0)
        assert fast(plant.path, plant.action(replace(state, time=time))) is not None
        assert plant.lockstep.step == 2


def test_the_fast_path_of_a_plant_ends_where_its_log_does() -> None:
    plant = Plant()
    state = plant.ordinary(plant.action(plant.begin(1, (3, 4))))
    assert fast(plant.path, plant.action(state)) is not None
    plant.path._log = plant.path._log[:2].copy()
    for _ in range(2):
        with armed(plant.path) as answer:
            for k in range(3):
                last = ArrayCodec(STATE.labels).decode(bytes(plant.path.answer.raw))
                assert (answer(plant.action(last)) is not None) == (k < 2)
    assert plant.lockstep.step == 6


def test_silence_is_noticed_after_the_fast_path() -> None:
    plant = Plant()
    state = plant.ordinary(plant.action(plant.begin(1, (3, 4))))
    for _ in range(3):
        plant.now += 0.05
        raw = plant.action(state)
        found = fast(plant.path, raw, plant.now)
        assert found is not None
        state = ArrayCodec(STATE.labels).decode(found)
    assert plant.lockstep.tick(plant.now + 0.09) == []
    (again,) = plant.lockstep.tick(plant.now + 0.11)
    assert plant.sent.encode(again.frame) == found


def test_repeats_before_an_answer_on_the_fast_path_are_not_counted_for_the_next_state() -> None:
    plant = Plant()  # which gives up after 3 repeats of one state
    state = plant.ordinary(plant.action(plant.begin(1, (3, 4))))
    for _ in range(2):
        for _ in range(3):
            plant.now += 0.11
            (again,) = plant.lockstep.tick(plant.now)
            assert again.topic is STATE
        found = fast(plant.path, plant.action(state), plant.now)
        assert found is not None
        state = ArrayCodec(STATE.labels).decode(found)


@pytest.mark.parametrize("contradicted", [0, 1, 2])
def test_every_action_of_the_fast_path_can_be_contradicted(contradicted: int) -> None:
    plant = Plant()
    state = plant.ordinary(plant.action(plant.begin(1, (3, 4))))
    taken = []
    with armed(plant.path) as answer:
        for _ in range(3):
            taken.append(plant.action(state))
            found = answer(taken[-1])
            assert found is not None
            state = ArrayCodec(STATE.labels).decode(found)
    for raw in taken:
        assert plant.lockstep.action(plant.own.decode(raw), 0.0) == []  # the same again
    other = with_number(taken[contradicted], 8, -1, 0.123)
    assert is_void(*plant.lockstep.action(plant.own.decode(other), 0.0))
    assert f"for step {contradicted + 1} of episode 1" in plant.lockstep.contradiction
