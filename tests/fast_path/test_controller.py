# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fast path of a controller: the bytes of the responder, and only where it may."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.messages.frames import HEADER, ArrayCodec, Frame, FrameError
from pdeloop.messages.topics import ACTION, COMPLETED, VOID
from tests.support.fast_path_pair import N_A, N_S, N_Z, Controller, armed, fast, with_number
from tests.support.lockstep import PLANT, RUN


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
