# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Signatures: only a controller that was told what the tuner published moves the plant."""

from __future__ import annotations

import contextlib
from dataclasses import asdict, replace

import numpy as np
import pytest

from controller_node.identification import DesignSettings
from controller_node.responder import Responder
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.model_rows import ModelRows, pack
from pdeloop.messages.protocol import design_digest
from pdeloop.messages.topics import (
    COMPLETED,
    COST,
    MODEL,
    POLICY,
    START,
    STATE,
    TARGET,
    VOID,
    CostColumn,
    Topic,
)
from tests.support.lockstep import is_void, plant_protocol
from tests.support.small import dispatcher_of
from tuner_node.batch import Batch, DispatchError

N_Z, N_A, N_S = 32, 4, 3
RNG = np.random.default_rng(0)
ROWS = np.array([[3.0, -1.0, 0.0, 0.0], [4.0, -1.0, 0.0, 0.0]])
EXPLORING = np.array([[3.0, 8.0, 0.1, 0.0], [4.0, 9.0, 0.1, 0.0]])
POLICIES = 0.1 * RNG.standard_normal((2, N_A, 2 * N_S))
GAINS = np.zeros((N_A, N_S))
MODELS = np.stack(
    [
        pack(
            ModelRows(
                A=np.zeros((N_S, N_S)),
                B=np.zeros((N_S, N_A)),
                U=np.linalg.qr(RNG.standard_normal((N_Z, N_S)))[0],
                K_a=GAINS,
                K_b=GAINS,
                s_r=np.zeros(N_S),
            )
        )
    ]
)
REFUSED = "not computed from the policy, model and target"


class Loop:
    """A tuner, a plant and a controller: the pure protocols as the nodes have them."""

    def __init__(self, rows: np.ndarray = ROWS) -> None:
        self.plant, self.rows = plant_protocol(), rows
        design = design_digest(asdict(DesignSettings(N_A, N_S, 1.0, 1.0)))
        self.tuner = dispatcher_of(run=5, n_a=N_A, incarnation=1, design=design)
        self.tuner.presence(0, (), 0.0)
        self.told: dict[Topic, Frame] = {TARGET: self.plant.announcement().frame}
        self.take(self.tuner.models(MODELS, 1))
        self.begin()
        self.controller = self.controller_told()

    def begin(self) -> None:
        exploring = bool(self.rows[0, 1] >= 0)
        self.take(self.tuner.assign(Batch(self.rows, None if exploring else POLICIES), 0.0))

    def take(self, publications) -> None:
        for _, send in publications:
            self.told[send.topic] = send.frame
            if send.topic is START:
                *_, state = self.plant.start(send.frame, 0.0)
                self.state = state.frame

    def controller_told(self, limit: float = 0.0, order: int = N_S, **others: object) -> Responder:
        """A controller that was told of the episode what the tuner published, but for `others`."""
        made = Responder(DesignSettings(N_A, order, 1.0, 1.0, action_set=ActionSet(limit=limit)))
        handlers = {
            TARGET: made.target, MODEL: made.model, POLICY: made.policy, START: made.start,
        }  # fmt: skip
        for topic, handle in handlers.items():
            if topic in self.told:
                frame = self.told[topic]
                handle(replace(frame, values=others.get(topic.name.split("/")[-1], frame.values)))
        return made

    def act(self, controller: Responder):
        """What the plant makes of a controller's answer to its state."""
        (action,) = controller.state(self.state)
        return self.plant.action(action.frame, 0.0)

    def finish(self, disturb=lambda: None) -> np.ndarray:
        """The costs of the episode, which the loop's own controller answers to the end."""
        while True:
            disturb()
            (send,) = self.act(self.controller)
            if send.topic is COST:
                return send.frame.values
            self.state = send.frame


def unsigned(frame: Frame) -> Frame:
    """The answer of a controller that knows nothing of signatures."""
    return replace(frame, values=np.full((len(frame.values), N_A), 0.5))


OTHERS = {
    "a policy": {"policy": POLICIES + 1e-9},
    "a model": {"model": MODELS * 1.5},
    "a target": {"target": np.full(N_Z, 0.25)},
    "rows": {"start": ROWS + np.array([0.0, 0.0, 0.5, 0.0])},
    "a limit": {"limit": 0.01},
}


@pytest.mark.parametrize("others", OTHERS.values(), ids=OTHERS)
def test_a_controller_that_was_told_something_else_never_moves_the_plant(others):
    expected = Loop().finish()
    loop = Loop()
    foreign = loop.controller_told(**others)

    def disturb() -> None:
        with pytest.raises(FrameError, match="expected an action of shape"):
            loop.plant.action(replace(loop.state, values=np.zeros((2, 3))), 0.0)
        with pytest.raises(FrameError, match=REFUSED):
            loop.act(foreign)

    assert loop.finish(disturb).tobytes() == expected.tobytes()


@pytest.mark.parametrize("topic", [POLICY, MODEL], ids=["policy", "model"])
@pytest.mark.parametrize("first", [True, False], ids=["first", "later"])
def test_a_controller_answers_by_the_policy_and_model_that_the_start_signs(topic, first):
    expected = Loop().finish()
    loop = Loop()
    true, count = loop.told[topic], 0

    def disturb() -> None:
        nonlocal count
        count += 1
        for step in (1, 2):  # more of them than are kept are told again, as the tuner's are
            with pytest.raises(
                FrameError, match=r"two different .* arrived .*; expected one tuner"
            ):
                handle(replace(true, values=true.values + 1e-3 * (count % 3) + step))
        with contextlib.suppress(FrameError):
            handle(true)

    if first:
        loop.controller = loop.controller_told(**{topic.name: true.values + 1e-3})
    handle = {POLICY: loop.controller.policy, MODEL: loop.controller.model}[topic]
    if first:
        with pytest.raises(FrameError, match=r"two different .* arrived .*; expected one tuner"):
            handle(true)
    assert loop.finish(disturb).tobytes() == expected.tobytes()


@pytest.mark.parametrize("first", [True, False], ids=["first", "later"])
@pytest.mark.parametrize(
    "other", [{"values": np.repeat(ROWS, 2, axis=0)}, {"plant": 9}, {"step": 2}], ids=str
)
def test_a_controller_that_cannot_know_the_start_says_so_and_the_episode_is_run_again(first, other):
    loop = Loop()
    start = loop.told[START]
    forged = replace(start, **other)
    controller = Responder(DesignSettings(N_A, N_S, 1.0, 1.0))
    assert controller.start(forged if first else start) == []
    (failure,) = controller.start(start if first else forged)
    assert "two different starts arrived for episode" in failure.reason
    loop.take(loop.tuner.failure(0, failure, 0.0))
    assert loop.told[START].episode == start.episode + 1
    assert loop.told[START].values.tobytes() == start.values.tobytes()


def test_a_start_of_an_earlier_episode_keeps_no_controller_from_answering():
    expected = Loop().finish()
    loop = Loop()
    start = loop.told[START]
    former = replace(start, episode=start.episode - 1, values=start.values[::-1])

    def disturb() -> None:
        assert loop.controller.start(former) == []

    assert loop.finish(disturb).tobytes() == expected.tobytes()


def test_a_cost_in_the_middle_of_an_episode_is_contradicted_by_the_controller():
    loop = Loop()
    true = loop.finish()
    (cost,) = loop.plant.start(loop.told[START], 0.0)
    assert loop.controller.cost(cost.frame) == []
    assert loop.tuner.cost(0, cost.frame, 0.0) == []
    loop.begin()
    for topic, handle in ((POLICY, loop.controller.policy), (START, loop.controller.start)):
        handle(loop.told[topic])
    for _ in range(3):
        (send,) = loop.act(loop.controller)
        loop.state = send.frame
    forged = replace(cost.frame, episode=loop.state.episode)
    assert loop.controller.cost(forged) == []
    loop.tuner.cost(0, forged, 0.0)
    ((_, _), (_, start)) = loop.tuner.assign(Batch(ROWS, POLICIES), 0.0)
    void, state = loop.plant.start(start.frame, 0.0)
    assert (void.topic, void.frame.step, state.topic) == (COST, 3, STATE)
    assert loop.tuner.cost(0, void.frame, 0.0) == []  # a plant started again may say so
    (failure,) = loop.controller.cost(void.frame)
    assert loop.controller.cost(void.frame) == []
    with pytest.raises(DispatchError, match=r"withdrew episode .* gave it up at step 3"):
        loop.tuner.failure(0, failure, 0.0)
    assert true.tobytes() == cost.frame.values.tobytes()


@pytest.mark.parametrize("twin", ["plant", "controller"])
@pytest.mark.parametrize("steps", [1, 30])
def test_a_second_plant_or_controller_of_the_same_kind_takes_nothing_back(twin, steps):
    """One of two plants is slower, or one of two controllers."""
    loop, slow = Loop(), plant_protocol()
    slower = loop.controller_told()
    (state,) = slow.start(loop.told[START], 0.0)
    for _ in range(steps):
        (action,) = slower.state(state.frame)
        (state,) = slow.action(action.frame, 0.0)
    loop.finish()
    (cost,) = loop.plant.start(loop.told[START], 0.0)
    loop.tuner.cost(0, cost.frame, 0.0)
    ((_, _), (_, start)) = loop.tuner.assign(Batch(ROWS, POLICIES), 0.0)
    gives_up = slow if twin == "plant" else loop.plant
    controller = loop.controller if twin == "plant" else slower
    assert controller.cost(cost.frame) == []
    for send in gives_up.start(start.frame, 0.0):
        if send.topic is COST:
            assert controller.cost(send.frame) == []
            assert loop.tuner.cost(0, send.frame, 0.0) == []


CLAIMS = {  # states answered, step of the cost, states answered after it, step of the void one: said
    "it went further": ([0, 1, 2], 30, [], 2, True),
    "not further than answered": ([0, 1, 2], 2, [], 1, False),
    "given up where it was": ([0, 1, 2], 5, [], 5, False),
    "another one answered before": ([3, 4], 30, [], 4, False),
    "answered after it": ([0, 1, 2], 5, [3, 4, 5], 4, False),
    "two plants, the slower one last": ([0, 1, 2, 1], 2, [], 1, False),
}


@pytest.mark.parametrize("answered, step, later, void, said", CLAIMS.values(), ids=CLAIMS)
def test_an_episode_that_is_given_up_short_of_its_cost_and_of_its_states_is_told(
    answered, step, later, void, said
):
    loop = Loop()

    def answer(steps) -> None:
        for k in steps:
            (action,) = loop.controller.state(replace(loop.state, step=k))
            assert action.topic.name == "action"

    def cost(at: int, ended: float) -> list:
        rows = np.tile([1.0, 1.0, ended], (len(ROWS), 1))
        return loop.controller.cost(replace(loop.state, step=at, values=rows))

    answer(answered)
    assert cost(step, COMPLETED) == []
    answer(later)
    assert len(cost(void, VOID)) == said


@pytest.mark.parametrize("rows", [ROWS, EXPLORING], ids=["policy", "exploration"])
def test_once_an_action_was_signed_no_unsigned_one_is_taken_for_the_whole_run(rows):
    expected = Loop(rows).finish()
    loop = Loop(rows)
    assert loop.finish().tobytes() == expected.tobytes()
    late = unsigned(loop.state)
    assert loop.plant.action(replace(late, step=2), 0.0) == []  # of an episode that is over
    (cost,) = loop.plant.start(loop.told[START], 0.0)
    loop.tuner.cost(0, cost.frame, 0.0)
    for send in loop.controller.cost(cost.frame):
        loop.tuner.model(0, send.frame, 0.0)

    # Nobody contradicts in the next one: the run's controller is silent all along.
    loop.rows = ROWS
    loop.begin()
    for time in (loop.state.time, 0.0, -1.0):
        with pytest.raises(FrameError, match=REFUSED):
            loop.plant.action(replace(unsigned(loop.state), time=time), 0.0)
    assert loop.plant.step == 0


def test_a_plant_that_is_started_again_still_knows_that_the_controller_of_its_run_signs():
    loop = Loop()
    loop.act(loop.controller)
    again = plant_protocol(signed_run=loop.plant.signed_run)
    (state,) = again.start(loop.told[START], 0.0)
    with pytest.raises(FrameError, match=REFUSED):
        again.action(unsigned(state.frame), 0.0)
    (action,) = loop.controller.state(state.frame)
    assert again.action(action.frame, 0.0)[0].frame.step == 1


def test_a_model_of_a_controller_with_other_parameters_is_refused_also_when_it_comes_first():
    loop = Loop(EXPLORING)
    other = loop.controller_told(order=2)
    loop.finish(lambda: other.state(loop.state))
    (cost,) = loop.plant.start(loop.told[START], 0.0)
    other.state(loop.state)
    (foreign,), (own,) = other.cost(cost.frame), loop.controller.cost(cost.frame)
    loop.tuner.cost(0, cost.frame, 0.0)
    for time in (own.frame.time, cost.frame.time):  # before its own and after it; not signed
        with pytest.raises(FrameError, match="with the parameters of this run's tuner"):
            loop.tuner.model(0, foreign.frame, 0.0)
        loop.tuner.model(0, replace(own.frame, time=time), 0.0)
    result = loop.tuner.result()
    assert result is not None and np.array_equal(result.models, own.frame.values)


def test_a_run_with_a_controller_that_does_not_sign_is_void_as_soon_as_another_signs():
    loop = Loop()
    for attempt in (1, 2, 3):
        for _ in range(3):
            (state,) = loop.plant.action(unsigned(loop.state), 0.0)
            loop.state = state.frame
        (cost,) = loop.act(loop.controller_told())
        assert (cost.frame.values[:, CostColumn.ENDED] == VOID).all()
        assert "does not sign; expected one controller" in loop.plant.contradiction
        if attempt < 3:
            loop.take(loop.tuner.cost(0, cost.frame, 0.0))
    with pytest.raises(DispatchError, match="gave up after 3 attempts"):
        loop.tuner.cost(0, cost.frame, 0.0)


@pytest.mark.parametrize("time", ["echoes", "0"])
def test_a_controller_that_does_not_sign_is_served_also_by_a_plant_that_is_started_again(time):
    loop = Loop()
    plant, sent = loop.plant, [loop.state]
    for step in range(40):
        action = unsigned(sent[-1]) if time == "echoes" else replace(unsigned(sent[-1]), time=0.0)
        (send,) = plant.action(action, 0.0)
        if send.topic is COST:
            break
        if step == 5:
            plant = plant_protocol(signed_run=plant.signed_run)
            (send,) = plant.start(loop.told[START], 0.0)
        sent.append(send.frame)
    assert send.topic is COST and not is_void(send)


def test_an_action_that_is_not_signed_is_not_awaited():
    loop = Loop()
    (send,) = loop.act(loop.controller)
    loop.state = send.frame
    (signed,) = loop.controller.state(loop.state)
    assert loop.plant.awaits(signed.frame)
    for time in (loop.state.time, 0.0, -1.0):
        assert not loop.plant.awaits(replace(signed.frame, time=time))


def test_a_tuner_that_asks_for_no_signature_gets_the_time_of_the_state():
    loop = Loop()
    loop.told[START] = replace(loop.told[START], plant=0)
    (action,) = loop.controller_told().state(loop.state)
    assert action.frame.time == loop.state.time > 0.0
