# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant's protocol: every fault on the way is an event here, and changes no number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loop_interfaces.frames import Frame, FrameError
from loop_interfaces.protocol import Publication
from loop_interfaces.topics import COMPLETED, COST, PAUSED, STATE, VOID, CostColumn
from pde_sim_node.build import build_plant
from pde_sim_node.lockstep import Lockstep
from pde_sim_node.real_time import Timing
from pde_sim_node.run_record import RunRecord, forget
from pde_sim_node.taken_actions import REMEMBERED
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


def test_an_episode_has_all_states_and_ends_with_its_cost():
    protocol = plant_protocol()
    *states, cost = run_episode(protocol, 1)
    assert [frame.step for frame in states] == list(range(31))
    assert cost.values.shape == (2, 3)
    assert (cost.values[:, CostColumn.ENDED] == COMPLETED).all()
    assert np.allclose(cost.values[:, CostColumn.TOTAL], 30 * cost.values[:, CostColumn.MEAN])
    times = [frame.time for frame in states]
    assert np.allclose(np.diff(times), 0.05)


def test_foreign_late_repeated_and_malformed_messages_change_no_number():
    quiet = run_episode(plant_protocol(), 1)

    def disturb(protocol, state, now):
        wrong = answer(state, scale=7.0)
        for bad in (
            replace(wrong, run=99),
            replace(wrong, episode=wrong.episode + 1),
            replace(wrong, step=wrong.step + 1),
            replace(wrong, plant=PLANT + 1),
        ):
            assert protocol.action(bad, now) == []
        with pytest.raises(FrameError, match="expected an action of shape"):
            protocol.action(replace(wrong, values=wrong.values[:1]), now)
        with pytest.raises(FrameError, match="holds this plant"):
            protocol.start(start(1, run=99), now)
        (again,) = protocol.start(start(1), now)
        assert again.frame.step == state.step

        if state.step:
            before = replace(states[state.step - 1], time=now)
            assert protocol.action(answer(before), now) == []  # the same answer, late

    states = quiet
    noisy_protocol = plant_protocol()
    noisy = run_episode(noisy_protocol, 1, disturb=disturb)
    assert [f.values.tobytes() for f in noisy[-1:]] == [f.values.tobytes() for f in quiet[-1:]]
    assert noisy_protocol.counters["actions of another step"] > 0


def test_two_different_actions_for_one_state_void_the_episode():
    quiet = run_episode(plant_protocol(), 1)
    protocol = plant_protocol()
    (send,) = protocol.start(start(1), 0.0)
    for step in range(20):
        assert send.frame.step == step
        (send,) = protocol.action(answer(send.frame, scale=7.0 if step == 3 else 0.1), 0.0)
    assert protocol.action(answer(quiet[3 - 1]), 0.0) == []
    other = answer(quiet[3])
    assert protocol.action(replace(other, values=other.values[:1]), 0.0) == []
    (void,) = protocol.action(answer(quiet[3]), 0.0)
    assert void.topic is COST
    assert (void.frame.values[:, CostColumn.ENDED] == VOID).all()
    assert protocol.contradiction.startswith(
        "two different actions arrived for step 3 of episode 1;"
    )
    again = run_episode(protocol, 2)
    assert again[-1].values.tobytes() == quiet[-1].values.tobytes()
    assert protocol.contradiction == ""


@pytest.mark.parametrize("environment", [0, 1])
def test_an_action_that_differs_in_one_environment_voids_the_episode(environment):
    protocol = plant_protocol()
    (send,) = protocol.start(start(1), 0.0)
    first = answer(kept(send.frame))
    protocol.action(first, 0.0)
    other = first.values.copy()
    other[environment, -1] += 1e-12
    assert is_void(*protocol.action(replace(first, values=other), 0.0))


def test_a_void_episode_is_not_declared_void_again_by_what_comes_later():
    protocol = plant_protocol()
    (send,) = protocol.start(start(1), 0.0)
    first = kept(send.frame)
    protocol.action(answer(first), 0.0)
    assert is_void(*protocol.action(answer(first, scale=0.2), 0.0))
    assert protocol.action(answer(first, scale=0.3), 0.0) == []


def test_silence_repeats_the_state_and_then_voids_the_episode():
    protocol = plant_protocol()
    (first,) = protocol.start(start(1), 0.0)
    assert protocol.tick(0.05) == []
    for n in (1, 2, 3):
        (again,) = protocol.tick(0.11 * n)
        assert again.topic is STATE
        assert again.frame.step == 0
    (void,) = protocol.tick(0.5)
    assert void.topic is COST
    assert (void.frame.values[:, CostColumn.ENDED] == VOID).all()
    assert protocol.deadline is None
    assert first.frame.step == 0
    assert len(run_episode(protocol, 2, now=1.0)) == 32  # a new number serves the same seeds again


def test_a_finished_episode_answers_again_with_the_same_cost():
    protocol = plant_protocol()
    cost = run_episode(protocol, 5)[-1]
    (again,) = protocol.start(start(5), 9.0)
    assert again.topic is COST
    assert again.frame.values.tobytes() == cost.values.tobytes()
    assert protocol.start(start(4), 9.0) == []  # an earlier one is stale


def test_a_restarted_plant_repeats_the_episode_to_the_bit():
    first = run_episode(plant_protocol(), 7)
    second = run_episode(plant_protocol(), 7)
    assert first[-1].values.tobytes() == second[-1].values.tobytes()


def test_a_run_holds_the_plant_until_it_ends_or_falls_silent():
    protocol = plant_protocol()
    protocol.start(start(1), 0.0)
    with pytest.raises(FrameError, match="holds this plant"):
        protocol.start(start(1, run=12), 5.0)
    assert protocol.start(start(1, run=12), 20.0)[0].frame.run == 12
    assert protocol.start(start(2, seeds=(), run=12), 21.0) == []  # release
    assert protocol.start(start(1, run=13), 21.1)[0].frame.run == 13


@pytest.mark.parametrize("rows", [[[0.5, -1, 0, 0]], [[-2, -1, 0, 0]], [[1, -1]]])
def test_malformed_seed_lists_are_refused_and_leave_the_plant_as_it_was(rows):
    protocol = plant_protocol()
    (state,) = protocol.start(start(1), 0.0)
    with pytest.raises(FrameError, match="expected"):
        protocol.start(Frame(RUN, 2, 0, 0.0, np.array(rows)), 0.1)
    assert protocol.episode == 1
    assert protocol.action(answer(state.frame), 0.2)[0].frame.step == 1


def test_a_diverged_rollout_is_a_finite_marked_cost_and_leaves_the_others_alone():
    quiet = run_episode(plant_protocol(), 1)[-1]
    protocol = plant_protocol()
    (send,) = protocol.start(start(1), 0.0)
    while send.topic is STATE:
        reply = answer(send.frame)
        if send.frame.step == 12:
            reply.values[0] = 1e9
        (send,) = protocol.action(reply, 0.0)
        assert np.isfinite(send.frame.values).all()
    bad, good = send.frame.values
    assert bad[CostColumn.ENDED] == 12
    assert bad[CostColumn.MEAN] == 1e9
    assert good.tobytes() == quiet.values[1].tobytes()


def test_simulated_time_only_grows_also_across_episodes_and_runs():
    protocol = plant_protocol()
    times = [frame.time for frame in run_episode(protocol, 1)[:-1]]
    times += [frame.time for frame in run_episode(protocol, 2)[:-1]]
    late = Frame(RUN, 3, 0, 1000.0, start(3).values)
    times.append(protocol.start(late, 0.0)[0].frame.time)
    assert (np.diff(times) > 0).all()
    assert times[-1] > 1000


def outcome(frames: list[Frame]) -> bytes:
    return b"".join(frame.values.tobytes() for frame in frames)


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


def test_a_run_that_is_served_keeps_the_plant_from_another_by_its_actions_too():
    protocol = plant_protocol()
    (sent,) = protocol.start(start(1), 0.0)
    protocol.action(answer(sent.frame), 9.0)  # a run is forgotten after 10 s
    with pytest.raises(FrameError, match=f"run {RUN} holds this plant"):
        protocol.start(start(1, run=RUN + 1), 18.0)
    assert protocol.start(start(1, run=RUN + 1), 19.0)


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


@pytest.mark.parametrize("later", [0, 3])
def test_an_action_that_contradicts_one_of_an_episode_that_ended_takes_its_cost_back(later):
    protocol = plant_protocol()
    *states, cost = run_episode(protocol, 1)
    for episode in range(2, 2 + later):
        run_episode(protocol, episode)
    for state in states[:-1]:
        assert protocol.action(answer(state), 1.0) == []  # the same again contradicts nothing
    late = answer(states[28], scale=0.2)
    for harmless in (replace(late, run=RUN + 1), replace(late, plant=1), replace(late, step=31)):
        assert protocol.action(harmless, 1.0) == []
    assert protocol.action(replace(late, values=late.values[:1]), 1.0) == []
    (send,) = protocol.action(late, 1.0)
    assert send.topic is COST
    assert (send.frame.run, send.frame.episode, send.frame.step) == (RUN, 1, cost.step)
    assert (send.frame.values[:, CostColumn.ENDED] == VOID).all()
    assert "two different actions arrived for step 28 of episode 1" in protocol.contradiction
    assert protocol.action(late, 1.0) == []
    run_episode(protocol, 9)
    assert protocol.contradiction == ""


def test_actions_of_the_last_16_episodes_can_be_contradicted_and_of_none_before():
    assert REMEMBERED == 16
    protocol = plant_protocol(horizon=3)
    states = {episode: run_episode(protocol, episode)[0] for episode in range(1, 21)}
    for episode in range(1, 21):
        sent = protocol.action(answer(states[episode], scale=0.2), 1.0)
        assert [(is_void(send), send.frame.episode) for send in sent] == (
            [(True, episode)] if episode > 4 else []
        )


OTHER_STARTS = {
    "other seeds": start(1, seeds=(5, 6)),
    "another signature": replace(start(1), plant=9),
    "both": replace(start(1, seeds=(5, 6)), plant=9),
}


@pytest.mark.parametrize("other", OTHER_STARTS.values(), ids=OTHER_STARTS)
def test_two_different_starts_void_the_episode(other):
    quiet = run_episode(plant_protocol(), 1)
    protocol = plant_protocol()
    (state,) = protocol.start(other, 0.0)  # the first to come is the forged one
    protocol.action(answer(state.frame), 0.0)
    for _ in range(2):
        (void,) = protocol.start(start(1), 0.0)
        assert void.topic is COST
        assert (void.frame.values[:, CostColumn.ENDED] == VOID).all()
    assert protocol.contradiction.startswith("two different starts arrived for episode 1;")
    assert outcome(run_episode(protocol, 2)) == outcome(quiet)


@pytest.mark.parametrize("later", [0, 3])
@pytest.mark.parametrize("other", OTHER_STARTS.values(), ids=OTHER_STARTS)
def test_a_start_that_contradicts_that_of_an_episode_that_ended_takes_its_cost_back(later, other):
    protocol = plant_protocol()
    cost = run_episode(protocol, 1)[-1]
    for episode in range(2, 2 + later):
        run_episode(protocol, episode)
    (send,) = protocol.start(other, 1.0)
    assert send.topic is COST
    assert (send.frame.run, send.frame.episode, send.frame.step) == (RUN, 1, cost.step)
    assert (send.frame.values[:, CostColumn.ENDED] == VOID).all()
    assert "two different starts arrived for episode 1" in protocol.contradiction
    assert (protocol.counters["costs taken back"], protocol.counters["episodes void"]) == (1, 0)
    # Whoever asks again is told the same.
    for asked in (start(1), other):
        again = protocol.start(asked, 1.0)
        assert [found.frame.values.tobytes() for found in again] == (
            [] if later else [send.frame.values.tobytes()]
        )


def test_only_the_action_that_will_be_taken_is_awaited():
    protocol = plant_protocol()
    (send,) = protocol.start(start(1), 0.0)
    good = answer(send.frame)
    others = (
        replace(good, run=RUN + 1),
        replace(good, episode=2),
        replace(good, step=1),
        replace(good, plant=1),
        replace(good, values=good.values[:1]),
        replace(good, values=good.values[:, :3]),
    )
    assert protocol.awaits(good) and not any(map(protocol.awaits, others))
    protocol.action(good, 0.0)
    assert not protocol.awaits(good)


def test_a_large_state_is_repeated_later(monkeypatch):
    """A state of many numbers is long on its way: it would be sent several times before an answer."""
    (sent,) = plant_protocol().start(start(1), now=0.0)
    monkeypatch.setattr("pde_sim_node.lockstep.SLOW", sent.frame.values.size / 4)
    protocol = plant_protocol()
    protocol.start(start(1), now=0.0)
    assert not protocol.tick(0.39)
    (again,) = protocol.tick(0.41)
    assert again.topic is STATE and protocol.counters["states repeated"] == 1
    protocol.action(answer(again.frame), now=0.5)
    assert not protocol.tick(0.89) and protocol.tick(0.91)
