"""The plant's protocol: every fault on the way is an event here, and changes no number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from loop_interfaces.frames import Frame, FrameError
from loop_interfaces.topics import COMPLETED, COST, STATE, VOID, CostColumn
from pde_sim_node.build import build_plant
from pde_sim_node.lockstep import Lockstep
from tests.small import parameters

RUN = 11
PLANT = 77
SEEDS = (3, 4)


def plant_protocol(**overrides) -> Lockstep:
    values = parameters(**overrides)
    return Lockstep(
        build_plant(values),
        fingerprint=PLANT,
        sample_time=0.05,
        action_timeout=0.1,
        max_repeats=3,
        run_hold=10.0,
    )


def start(episode: int, seeds=SEEDS, run: int = RUN) -> Frame:
    rows = np.array([(seed, -1.0, 0.0, 0.0) for seed in seeds], dtype=float).reshape(-1, 4)
    return Frame(run, episode, 0, 0.0, rows)


def answer(state: Frame, scale: float = 0.1) -> Frame:
    actions = scale * state.values[:, :4]
    return replace(state, values=actions)


def run_episode(protocol: Lockstep, episode: int, now: float = 0.0, disturb=None) -> list[Frame]:
    """All frames of an episode; `disturb(protocol, state, now)` may interfere before each answer."""
    (send,) = protocol.start(start(episode), now)
    frames = [send.frame]
    while send.topic is STATE:
        now += 0.01
        if disturb:
            disturb(protocol, send.frame, now)
        (send,) = protocol.action(answer(send.frame), now)
        frames.append(send.frame)
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
            replace(wrong, step=wrong.step - 1),
            replace(wrong, plant=PLANT + 1),
        ):
            assert protocol.action(bad, now) == []
        with pytest.raises(FrameError, match="expected an action of shape"):
            protocol.action(replace(wrong, values=wrong.values[:1]), now)
        with pytest.raises(FrameError, match="has this plant"):
            protocol.start(start(1, run=99), now)
        with pytest.raises(FrameError, match="other seeds"):
            protocol.start(start(1, seeds=(5, 6)), now)
        (again,) = protocol.start(start(1), now)
        assert again.frame.step == state.step

    noisy_protocol = plant_protocol()
    noisy = run_episode(noisy_protocol, 1, disturb=disturb)
    assert [f.values.tobytes() for f in noisy[-1:]] == [f.values.tobytes() for f in quiet[-1:]]
    assert noisy_protocol.tally["actions of another step"] > 0


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
    with pytest.raises(FrameError, match="has this plant"):
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
