# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant's protocol: every fault on the way is an event here, and changes no number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdeloop.messages.frames import Frame, FrameError
from pdeloop.messages.topics import COMPLETED, COST, STATE, VOID, CostColumn
from tests.support.lockstep import PLANT, RUN, answer, plant_protocol, run_episode, start


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


def test_a_run_that_is_served_keeps_the_plant_from_another_by_its_actions_too():
    protocol = plant_protocol()
    (sent,) = protocol.start(start(1), 0.0)
    protocol.action(answer(sent.frame), 9.0)  # a run is forgotten after 10 s
    with pytest.raises(FrameError, match=f"run {RUN} holds this plant"):
        protocol.start(start(1, run=RUN + 1), 18.0)
    assert protocol.start(start(1, run=RUN + 1), 19.0)


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
