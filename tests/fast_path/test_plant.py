# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fast path of a plant: the bytes of the lock-step, and only where it may."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdeloop.messages.frames import HEADER, ArrayCodec, FrameError
from pdeloop.messages.protocol import signature
from pdeloop.messages.topics import COST, STATE
from tests.support.fast_path_pair import Plant, armed, fast, with_number
from tests.support.lockstep import PLANT, RUN, is_void


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
