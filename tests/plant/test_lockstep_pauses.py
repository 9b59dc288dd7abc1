# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant's protocol under pauses, single steps and a pace: no number changes."""

from __future__ import annotations

import numpy as np
import pytest

from pde_sim_node.lockstep import Lockstep
from pde_sim_node.real_time import Timing
from pde_sim_node.run_record import RunRecord, forget
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import COST, PAUSED, STATE
from tests.support.lockstep import RUN, answer, kept, outcome, plant_protocol, run_episode, start


def test_a_paused_plant_holds_the_next_state_back_and_times_nothing_out():
    quiet = run_episode(plant_protocol(), 1)

    def pause_for_long(protocol, state, now):
        if state.step not in (0, 12, 30):
            return
        (report,) = protocol.pause(now)
        assert report.topic is PAUSED
        assert report.frame.values.tolist() == [1.0]
        assert (report.frame.run, report.frame.episode) == (RUN, 1)
        for later in np.arange(now + 0.1, now + 60.0, 0.5):  # far past the void limit of 0.4 s
            for send in protocol.tick(later):
                assert send.topic is PAUSED
            assert not protocol.overdue()
        report, again = protocol.resume(now + 60.0)
        assert report.frame.values.tolist() == [0.0]
        assert (again.topic, again.frame.step) == (STATE, state.step)

    paused = run_episode(plant_protocol(), 1, disturb=pause_for_long)
    assert outcome(paused) == outcome(quiet)


@pytest.mark.parametrize("paused_in", ["no run", "this run", "a run that has ended"])
def test_a_plant_that_was_paused_is_paused_when_it_is_started_again(tmp_path, paused_in):
    quiet = run_episode(plant_protocol(), 1)
    former, records = plant_protocol(), tmp_path / "records"
    record = RunRecord("/pair/plant", 7, records)
    assert (record.paused, record.signed) == (False, 0)
    if paused_in == "this run":
        former.start(start(1), 0.0)
    former.pause(0.0)
    if paused_in == "a run that has ended":
        former.start(start(2, seeds=()), 1.0)
    record.keep(former.paused, 5)
    for other in (("/pair/other", 7), ("/pair/plant", 8), ("/pair/plant", 70)):
        assert not RunRecord(*other, records).paused
    again = RunRecord("/pair/plant", 7, records)
    assert again.signed == 5
    protocol = plant_protocol(paused=again.paused)
    assert protocol.paused_report().frame.values.tolist() == [1.0]
    for now in range(1, 60):
        if now == 3:
            assert protocol.start(start(1), 3.0) == []
        assert {send.topic for send in protocol.tick(float(now))} <= {PAUSED}
    _, state = protocol.resume(60.0)
    assert state.frame.values.tobytes() == quiet[0].values.tobytes()
    assert [send.topic for send in protocol.start(start(2), 61.0)] == [COST, STATE]

    (records / "7+pair+plant").write_text("x")  # damaged
    assert not RunRecord("/pair/plant", 7, records).paused
    RunRecord("/pair/plant", 8, records).keep(True, 0)
    again.keep(True, 6)
    forget(7, records)
    assert not RunRecord("/pair/plant", 7, records).paused
    assert RunRecord("/pair/plant", 8, records).paused


def test_what_is_recorded_of_a_plant_is_what_was_kept_last(tmp_path):
    record = RunRecord("/plant", 7, tmp_path)
    for paused, signed in ((False, 5), (True, 5), (False, 5), (False, 6), (True, 6), (True, 9)):
        record.keep(paused, signed)
        again = RunRecord("/plant", 7, tmp_path)
        assert (again.paused, again.signed) == (paused, signed)


def test_an_action_advances_the_plant_at_once_unless_it_is_paused_or_paced():
    protocol = plant_protocol()
    assert protocol.awaiting is None
    (sent,) = protocol.start(start(1), 0.0)
    assert protocol.awaiting is not None and protocol.awaiting.step == sent.frame.step
    protocol.pause(0.0)
    assert protocol.awaiting is None
    protocol.resume(0.0)
    assert protocol.awaiting is not None
    protocol.adjust(0.0, Timing(0.1, 3, 10.0, real_time_factor=1.0))
    assert protocol.awaiting is None


def test_a_paused_plant_says_so_once_a_second():
    protocol = plant_protocol()
    protocol.pause(0.0)
    said = [now for now in np.arange(0.0, 10.0, 0.1) if protocol.tick(now)]
    assert 9 <= len(said) <= 10
    protocol.resume(10.0)
    assert protocol.tick(20.0) == []


@pytest.mark.parametrize("last", [False, True], ids=["a step", "the end of an episode"])
def test_a_paused_plant_says_so_a_second_after_what_it_did_in_the_pause(last):
    protocol = plant_protocol(horizon=6)
    (sent,) = protocol.start(start(1), 0.0)
    while last and sent.frame.step < 6:
        (sent,) = protocol.action(answer(sent.frame), 0.0)
    protocol.pause(0.0)
    answered = protocol.action(answer(sent.frame), 0.5)
    assert [p.topic for p in answered] == ([COST] if last else [])
    assert protocol.deadline == 1.5 and protocol.tick(1.4) == []
    assert [p.topic for p in protocol.tick(1.5)] == [PAUSED]
    protocol.resume(2.0)
    assert (protocol.deadline is None) == last


def test_the_answer_on_its_way_is_taken_in_a_pause_and_then_every_step_lets_one_through():
    quiet = run_episode(plant_protocol(), 1)
    protocol = plant_protocol()
    (send,) = protocol.start(start(1), 0.0)
    frames = [kept(send.frame)]
    protocol.pause(0.0)
    assert protocol.action(answer(send.frame), 0.0) == []  # state 1 is held back
    now = 0.0
    while True:
        now += 0.5
        assert protocol.start(start(1), now) == []  # the tuner asks again: nothing slips out
        (send,) = protocol.step_once(now)
        frames.append(kept(send.frame))
        with pytest.raises(ValueError, match="still waits for its action"):
            protocol.step_once(now)
        again, report = protocol.tick(now + 0.2)  # an answer that is lost is asked for again
        assert (again, report.topic) == (send, PAUSED)
        answered = protocol.action(answer(send.frame), now + 0.3)
        if send.frame.step == 30:
            (cost,) = answered
            break
        assert answered == []
        assert protocol.step == len(frames)
    assert outcome([*frames, cost.frame]) == outcome(quiet)
    with pytest.raises(ValueError, match="no episode is under way"):
        protocol.step_once(now)


def test_an_episode_that_starts_in_a_pause_waits_and_a_run_may_end_in_it():
    protocol = plant_protocol()
    protocol.pause(0.0)
    assert protocol.start(start(1), 1.0) == []
    _, state = protocol.resume(2.0)
    assert (state.topic, state.frame.step) == (STATE, 0)
    protocol.pause(3.0)
    assert protocol.start(start(2, seeds=()), 4.0) == []
    (report,) = protocol.resume(5.0)
    assert report.topic is PAUSED
    assert protocol.resume(6.0) == []
    with pytest.raises(ValueError, match="not paused"):
        protocol.step_once(6.0)
    assert len(run_episode(protocol, 3, now=7.0)) == 32


def test_a_stepped_plant_whose_controller_is_gone_never_gives_up():
    protocol = plant_protocol()
    protocol.start(start(1), 0.0)
    protocol.pause(0.0)
    protocol.step_once(0.0)
    for now in np.arange(0.2, 100.0, 0.2):
        assert all(send.topic in (STATE, PAUSED) for send in protocol.tick(now))
    assert protocol.overdue()
    assert protocol.active
    protocol.pause(100.0)  # nobody waits for an action now
    assert not protocol.overdue()


def paced(protocol: Lockstep, episode: int, change=None) -> list[Frame]:
    """An episode in small steps of time; `change(protocol, state, now)` may turn the knobs."""
    now, frames, waiting = 0.0, [], None
    sends = protocol.start(start(episode), now)
    while True:
        for send in sends:
            if send.topic is COST:
                return [*frames, send.frame]
            if send.topic is STATE:
                waiting = send.frame
                frames.append(kept(send.frame))
        now += 0.004
        if waiting is not None:
            frame, waiting = waiting, None
            sends = protocol.action(answer(frame), now)
            sends = [*sends, *protocol.tick(now)]
            if change:
                sends += change(protocol, frame, now)
        else:
            sends = protocol.tick(now)
        assert now < 10.0


def test_pace_and_times_may_change_within_an_episode_and_change_no_number():
    quiet = run_episode(plant_protocol(), 1)
    times = {"action_timeout": 0.1, "max_repeats": 3, "run_hold": 10.0}
    factors = {5: 2.0, 9: 0.0, 14: 4.0, 20: 1.0, 25: 0.0}

    def change(protocol, state, now):
        if state.step in factors:
            return protocol.adjust(now, Timing(**times, real_time_factor=factors[state.step]))
        return []

    protocol = plant_protocol()
    assert outcome(paced(protocol, 1, change)) == outcome(quiet)
    assert protocol.pacer is None


def test_a_pause_moves_the_instants_of_a_paced_plant():
    quiet = run_episode(plant_protocol(), 1)
    protocol = plant_protocol()
    protocol.adjust(
        0.0, Timing(action_timeout=0.1, max_repeats=3, run_hold=10.0, real_time_factor=1.0)
    )

    def change(protocol, state, now):
        if state.step == 10:
            return protocol.pause(now)
        return []

    now, steps = 0.0, []
    sends = protocol.start(start(1), now)
    for _ in range(2000):
        now += 0.004
        nexts = protocol.tick(now)
        for send in sends:
            if send.topic is STATE:
                steps.append((now, kept(send.frame)))
                nexts += protocol.action(answer(send.frame), now)
                nexts += change(protocol, send.frame, now)
        if protocol.paused and now - steps[-1][0] > 1.0:
            nexts += protocol.resume(now)
        sends = nexts
    assert outcome([frame for _, frame in steps]) == outcome(quiet[:-1])
    gaps = np.diff([when for when, _ in steps])
    assert gaps[10] > 1.0
    assert np.delete(gaps, 10).max() < 0.06
    assert np.delete(gaps, 10).min() > 0.04
    assert protocol.pacer.missed == 0
