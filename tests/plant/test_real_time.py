# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The pace of a plant in real time: a pure grid of instants, and what missed it."""

from __future__ import annotations

import numpy as np
import pytest

from pde_sim_node.build import build_plant
from pde_sim_node.lockstep import Lockstep
from pde_sim_node.real_time import RealTimePacer, Timing
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import STATE
from tests.support.small import parameters, same_bits


def test_states_on_time_keep_the_grid_of_the_first_one() -> None:
    pacer = RealTimePacer(0.05)
    pacer.begin(10.0)
    for k in range(1, 100):
        due = pacer.next(10.0 + 0.05 * (k - 1) + 0.01)
        assert due == pytest.approx(10.0 + 0.05 * k)
        assert not pacer.ready(due - 0.02)
        assert pacer.ready(due + 1e-4)
    assert (pacer.count, pacer.missed) == (99, 0)
    assert pacer.largest == pytest.approx(1e-4)


def test_a_late_answer_and_a_slow_step_are_missed_deadlines_and_move_the_grid() -> None:
    pacer = RealTimePacer(0.05)
    pacer.begin(0.0)
    pacer.next(0.06)  # the answer came 10 ms late
    assert pacer.ready(0.061)
    assert pacer.next(0.07) == pytest.approx(0.111)
    assert pacer.ready(0.2)  # the step took so long that nobody asked before the instant
    assert (pacer.count, pacer.missed) == (2, 2)
    assert pacer.next(0.21) == pytest.approx(0.25)
    assert not pacer.ready(0.22)
    assert pacer.ready(0.3)  # ready in time, woken late: jitter, not a missed deadline
    assert (pacer.count, pacer.missed) == (3, 2)


def test_quantiles_are_those_of_the_sorted_lateness_to_a_class() -> None:
    rng = np.random.default_rng(1)
    lateness = rng.lognormal(np.log(1e-4), 1.0, 2000)
    pacer = RealTimePacer(1.0)
    pacer.begin(0.0)
    for late in lateness:
        due = pacer.next(0.0)
        pacer.ready(due - 0.5)
        pacer.ready(due + late)
    for share in (0.5, 0.99):
        expected = np.quantile(lateness, share, method="inverted_cdf")
        assert pacer.quantile(share) == pytest.approx(expected, rel=0.03)
    assert pacer.quantile(1.0) == pytest.approx(lateness.max(), rel=1e-6)
    assert "2000 states every 1000 ms, 0 missed deadlines" in pacer.summary()


def test_a_paced_plant_sends_each_state_at_its_instant_and_steps_before_it() -> None:
    values = parameters()
    plant = build_plant(values)
    lockstep = Lockstep(
        plant, Timing(action_timeout=0.05, max_repeats=3, run_hold=10.0, real_time_factor=0.5)
    )
    rows = np.array([[3.0, -1.0, 0.0, 0.0]])
    (first,) = lockstep.start(Frame(5, 1, 0, 0.0, rows), 1.0)
    assert first.topic is STATE
    period = values["sample_time"] / 0.5

    def answer(step: int) -> Frame:
        return Frame(5, 1, step, 0.0, np.zeros((1, values["n_a"])))

    assert lockstep.action(answer(0), 1.01) == []
    assert plant.step_index == 1  # computed at once, only sent later
    assert lockstep.deadline == pytest.approx(1.0 + period)
    assert lockstep.tick(1.02) == []
    assert lockstep.action(answer(1), 1.03) == []  # nobody can know state 1 yet
    assert plant.step_index == 1
    (second,) = lockstep.tick(1.0 + period)
    assert second.frame.step == 1
    assert lockstep.deadline == pytest.approx(1.0 + period + 0.05)
    (again,) = lockstep.tick(1.0 + period + 0.06)  # no answer: repeated as ever
    assert (again.topic, again.frame.step) == (STATE, 1)
    assert same_bits(again.frame.values, second.frame.values)
    assert lockstep.pacer is not None
    assert (lockstep.pacer.count, lockstep.pacer.missed) == (1, 0)


def test_the_end_of_a_run_drops_a_state_that_waits_for_its_instant() -> None:
    values = parameters()
    lockstep = Lockstep(
        build_plant(values),
        Timing(action_timeout=0.05, max_repeats=3, run_hold=10.0, real_time_factor=1.0),
    )
    rows = np.array([[3.0, -1.0, 0.0, 0.0]])
    lockstep.start(Frame(5, 1, 0, 0.0, rows), 1.0)
    lockstep.action(Frame(5, 1, 0, 0.0, np.zeros((1, values["n_a"]))), 1.01)
    lockstep.start(Frame(5, 0, 0, 0.0, rows[:0]), 1.02)
    assert lockstep.deadline is None
    assert lockstep.tick(5.0) == []
