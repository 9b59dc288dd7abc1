"""The short way from bytes to bytes: the same bytes as the long one, and only where it may."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from controller_node.identification import DesignSettings
from controller_node.reflex import Reflex as ControllerReflex
from controller_node.responder import Responder
from loop_interfaces import model_rows
from loop_interfaces.frames import HEADER, ArrayCodec, Frame
from loop_interfaces.topics import ACTION, COST, STATE, VOID, CostColumn
from pde_sim_node.reflex import Reflex as PlantReflex
from tests.test_lockstep import PLANT, RUN, plant_protocol

N_Z, N_S, N_A = 37, 5, 3
RNG = np.random.default_rng(0)


def with_number(raw: bytes, values: int, place: int, number: float) -> bytes:
    """A message of so many values with another number, counted from the header or from the end."""
    at = len(raw) + 8 * (place - HEADER - values if place >= 0 else place)
    return raw[:at] + struct.pack("<d", number) + raw[at + 8 :]


class Controller:
    """A responder in the middle of an episode, with its reflex and the codecs of its peer."""

    def __init__(self, batch: int, *, limit: float = 0.0) -> None:
        self.settings = DesignSettings(
            n_a=N_A,
            dmdc_rank=8,
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
        self.reflex = ControllerReflex(self.responder, self.own)

    def begin(self, episode: int) -> None:
        rows = np.zeros((self.batch, 4))
        rows[:, 1], rows[:, 3] = -1, np.arange(self.batch) % 2
        policies = RNG.standard_normal((self.batch, N_A, 2 * N_S))
        for responder in (self.responder, self.judge):
            responder.policy(Frame(RUN, episode, 0, 0.0, policies))
            responder.start(Frame(RUN, episode, 0, 0.0, rows))

    def state(self, episode: int, step: int, run: int = RUN) -> bytes:
        values = RNG.standard_normal((self.batch, N_Z))
        return self.peer.encode(Frame(run, episode, step, 0.1 * step, values, PLANT))

    def long_way(self, raw: bytes) -> bytes:
        frame = self.own.decode(raw)
        self.reflex.forget()
        (send,) = self.responder.state(frame)
        self.reflex.learn(frame)
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
        assert controller.reflex(first) is None
        assert controller.long_way(first) == controller.expected(first)
        for step in range(1, 6):
            raw = controller.state(episode, step)
            found = controller.reflex(raw)
            assert found is not None
            assert bytes(found) == controller.expected(raw)
            assert controller.reflex(raw) == found  # asked again: answered the same
    if limit:
        assert abs(ArrayCodec(ACTION.labels).decode(bytes(found)).values).max() == limit


def test_a_controller_takes_the_long_way_with_everything_else() -> None:
    controller = Controller(3)
    controller.begin(4)
    good = controller.state(4, 1)
    controller.long_way(controller.state(4, 0))
    assert controller.reflex(good)
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
        assert controller.reflex(with_number(good, 3 * N_Z, place, number)) is None, (place, number)
    others = Controller(4)
    for raw in (b"", good[:-8], good + bytes(8), good[:4], others.state(4, 1)):
        assert controller.reflex(raw) is None
    # Padding of ordinary message objects is undefined; the labels themselves are not.
    assert controller.reflex(good.replace(b"env", b"enw", 1)) is None
    assert controller.reflex(good)


def test_a_controller_forgets_with_every_other_message_and_counts_what_it_answered() -> None:
    controller = Controller(2)
    controller.begin(4)
    controller.long_way(controller.state(4, 0))
    for step in range(1, 8):
        assert controller.reflex(controller.state(4, step))
    assert (controller.responder.answered, controller.responder.step) == (1, 0)
    controller.reflex.settle()
    assert (controller.responder.answered, controller.responder.step) == (8, 7)
    controller.reflex.forget()
    assert controller.reflex(controller.state(4, 8)) is None
    # Where the controller explores there is no law.
    rows = np.array([[0.0, 3.0, 0.1, 0.0]] * 2)
    controller.responder.start(Frame(RUN, 5, 0, 0.0, rows))
    controller.long_way(controller.state(5, 0))
    assert controller.reflex(controller.state(5, 1)) is None
    assert controller.responder.answered == 9


class Plant:
    """A lock-step with its reflex, and one that only goes the long way."""

    def __init__(self, **overrides: object) -> None:
        self.now = 0.0
        self.lockstep, self.judge = (plant_protocol(**overrides) for _ in range(2))
        self.peer, self.own, self.sent = (
            ArrayCodec(ACTION.labels),
            ArrayCodec(ACTION.labels),
            ArrayCodec(STATE.labels),
        )
        self.reflex = PlantReflex(self.lockstep, self.own)

    def begin(self, episode: int, seeds: tuple[int, ...]) -> Frame:
        rows = np.zeros((len(seeds), 4))
        rows[:, 0], rows[:, 1] = seeds, -1
        for lockstep in (self.lockstep, self.judge):
            (send,) = lockstep.start(Frame(RUN, episode, 0, 0.0, rows), self.now)
        return send.frame

    def action(self, state: Frame) -> bytes:
        values = 0.1 * RNG.standard_normal((len(state.values), 4))
        return self.peer.encode(replace(state, values=values))

    def long_way(self, raw: bytes) -> Frame:
        frame = self.own.decode(raw)
        (send,) = self.lockstep.action(frame, self.now)
        self.reflex.learn(frame)
        return send.frame

    def expected(self, raw: bytes) -> tuple[object, Frame]:
        (send,) = self.judge.action(ArrayCodec(ACTION.labels).decode(raw), self.now)
        return send.topic, send.frame


@pytest.mark.parametrize(
    "overrides",
    [
        {},
        {"measurement_noise": 0.1, "process_noise": 0.01, "action_limit": 0.05},
        {"sensors": 5, "sensor_delays": 3},
    ],
)
def test_a_plant_goes_on_with_the_same_bytes(overrides: dict) -> None:
    plant = Plant(**overrides)
    for episode, seeds in ((1, (3, 4)), (2, (5, 6)), (7, (1, 2, 3))):
        state = plant.begin(episode, seeds)
        short = 0
        while True:
            plant.now += 0.01
            raw = plant.action(state)
            topic, expected = plant.expected(raw)
            found = plant.reflex(raw, plant.now)
            if topic is COST:
                assert found is None
                cost = plant.long_way(raw)
                assert cost.values.tobytes() == expected.values.tobytes()
                break
            if found is None:
                plant.long_way(raw)
            else:
                short += 1
                assert bytes(found) == plant.sent.encode(expected)
            last = plant.lockstep.last_state
            assert last is not None
            assert plant.sent.encode(last) == plant.sent.encode(expected)
            state = expected
        assert short == plant.lockstep.horizon - 1  # all but the first and the last
    assert plant.lockstep.tally == plant.judge.tally
    assert (plant.lockstep.steps_total, plant.lockstep.rounds_total, plant.lockstep.time) == (
        plant.judge.steps_total,
        plant.judge.rounds_total,
        plant.judge.time,
    )


def test_a_plant_takes_the_long_way_with_everything_else() -> None:
    plant = Plant()
    state = plant.begin(1, (3, 4))
    assert plant.reflex(plant.action(state), 0.0) is None
    state = plant.long_way(plant.action(state))
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
        assert plant.reflex(with_number(good, 8, place, number), 0.0) is None, (place, number)
    for raw in (b"", good[:-8], good + bytes(8)):
        assert plant.reflex(raw, 0.0) is None
    assert plant.lockstep.step == 1
    plant.lockstep.pause(0.0)
    assert plant.reflex(good, 0.0) is None
    plant.lockstep.resume(0.0)
    first = plant.reflex(good, 0.0)
    assert first is not None
    assert plant.reflex(good, 0.0) is None  # a duplicate of what was taken
    assert plant.lockstep.step == 2

    # Nor does it learn from what was not taken: an action for another plant, another episode or step.
    state = ArrayCodec(STATE.labels).decode(bytes(first))
    strangers = (
        replace(state, plant=PLANT + 1),
        replace(state, run=RUN + 1),
        replace(state, episode=2),
        replace(state, step=1),
        replace(state, plant=PLANT + 1, values=state.values[:1]),
    )
    for stranger in strangers:
        raw = plant.peer.encode(replace(stranger, values=np.full((len(stranger.values), 4), 0.5)))
        frame = plant.own.decode(raw)
        if stranger.step == 1:
            continue  # to another answer the plant objects, see below
        assert plant.lockstep.action(frame, 0.0) == []
        plant.reflex.learn(frame)
        assert plant.reflex(raw, 0.0) is None
        assert plant.reflex(plant.action(state), 0.0) is None
    assert plant.lockstep.step == 2
    plant.long_way(plant.action(state))
    assert plant.lockstep.step == 3

    # Nothing of an episode is taken for one of the next.
    plant.begin(2, (5, 6))
    late = with_number(good, 8, STEP_AT, 0.0)
    assert plant.reflex(late, 0.0) is None
    assert plant.lockstep.step == 0


def test_silence_and_contradictions_are_noticed_after_the_short_way() -> None:
    plant = Plant()
    state = plant.long_way(plant.action(plant.begin(1, (3, 4))))
    for _ in range(3):
        plant.now += 0.05
        raw = plant.action(state)
        found = plant.reflex(raw, plant.now)
        assert found is not None
        state = ArrayCodec(STATE.labels).decode(bytes(found))
    assert plant.lockstep.tick(plant.now + 0.09) == []
    (again,) = plant.lockstep.tick(plant.now + 0.11)
    assert plant.sent.encode(again.frame) == bytes(found)

    # The same answer again is a duplicate, another one to the same state voids the episode.
    assert plant.lockstep.action(plant.own.decode(raw), plant.now) == []
    other = with_number(raw, 8, -1, 0.123)
    (cost,) = plant.lockstep.action(plant.own.decode(other), plant.now)
    assert cost.topic is COST
    assert (cost.frame.values[:, CostColumn.ENDED] == VOID).all()
    assert plant.lockstep.contradiction
