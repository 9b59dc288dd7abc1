# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What the viewer makes of the loop's messages: numbers, profile, picture."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence

import numpy as np
import pytest

from pdeloop.messages.diagnostics import Level
from pdeloop.messages.frames import Frame
from pdeloop.messages.model_rows import ModelRows, pack
from pdeloop.messages.topics import VIEW_NUMBERS
from viewer_node.diagnostics import ViewerDiagnostics
from viewer_node.episode_samples import COLUMNS
from viewer_node.loop_view import LoopView
from viewer_node.picture import UNSEEN, diverging
from viewer_node.rollout_costs import MAX_BYTES, RolloutCosts

RUN, PLANT, N_Z, N_A, N_S = 5, 9, 8, 2, 3
RNG = np.random.default_rng(4)
MODEL = ModelRows(
    U=np.linalg.qr(RNG.normal(size=(N_Z, N_S)))[0],
    A=RNG.normal(size=(N_S, N_S)),
    B=RNG.normal(size=(N_S, N_A)),
    K_a=RNG.normal(size=(N_A, N_S)),
    K_b=RNG.normal(size=(N_A, N_S)),
    s_r=RNG.normal(size=N_S),
)
TARGET = np.linspace(0.0, 1.0, N_Z)


def frame(values, episode: int = 1, step: int = 0, plant: int = PLANT) -> Frame:
    return Frame(RUN, episode, step, 0.0, np.asarray(values, dtype=float), plant)


def test_what_comes_under_ever_new_ids_fills_no_memory():
    made = LoopView()
    tracemalloc.start()
    for i in range(40):
        large = np.zeros((1, 1, 2**20))
        made.policy(frame(large, episode=i), 0.0)
        made.model(frame(large, step=i), 0.0)
        made.start(frame(np.zeros((2**18, 4)), episode=i), 0.0)
        made.target(frame(large.ravel(), plant=i), 0.0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5 * MAX_BYTES


def view() -> LoopView:
    made = LoopView(horizon=10, weights=(2.0, 0.5))
    made.target(frame(TARGET, 0), 0.0)
    return made


def begin(
    shown: LoopView,
    policies,
    episode: int = 1,
    noise: tuple[float, ...] = (),
    fields: Sequence[float] = (),
) -> None:
    rows = [(field, -1.0, 0.0, 0.0, *noise) for field in fields or range(len(policies))]
    shown.model(frame(pack(MODEL)[None], 0, step=1), 0.0)
    shown.policy(frame(policies, episode, step=1), 0.0)
    shown.start(frame(rows, episode, step=1), 0.0)


def test_a_view_of_nothing_has_nothing_to_show():
    empty = LoopView()
    assert empty.numbers() == {}
    assert empty.profile() is None
    assert empty.space_time(0.0) is None


def test_the_first_law_without_gains_is_told_from_adapted_ones():
    """Of a law with other parameters nobody publishes the first: they follow the exploration."""
    first = RNG.normal(size=7)

    def seen(costs: RolloutCosts, episode: int, *thetas) -> list[str]:
        costs.policy(frame(thetas, episode, step=1))
        costs.start(frame([(0, -1.0, 0.0, 0.0)] * len(thetas), episode, step=1))
        return [costs.controller(RUN, episode, row) for row in range(len(thetas))]

    assert seen(RolloutCosts(), 2, first, first) == ["adapted"] * 2  # who came late cannot know
    costs = RolloutCosts()
    costs.start(frame([(0, 5.0, 0.1, 0.0)], 1, step=1))
    assert seen(costs, 2, first, first) == ["lqt"] * 2
    assert seen(costs, 3, first + 1.0, first) == ["adapted", "lqt"]
    assert seen(costs, 4, 0.0 * first, first, first + 2.0) == ["none", "lqt", "adapted"]
    pairs = RolloutCosts()  # of an optimiser that begins with other laws
    pairs.start(frame([(0, 5.0, 0.1, 0.0)], 1, step=1))
    assert seen(pairs, 2, first + 0.1, first - 0.1) == ["adapted"] * 2


def test_the_numbers_of_a_sample_are_those_of_their_definitions():
    shown = view()
    z = RNG.normal(size=(2, N_Z))
    a = RNG.normal(size=(2, N_A))
    shown.state(frame(z, step=3), 0.0)
    shown.action(frame(a, step=3), 0.0)
    numbers = shown.numbers()
    error = z[0] - TARGET
    assert numbers["step"] == 3.0
    assert numbers["tracking_error"] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert numbers["action_norm"] == pytest.approx(np.linalg.norm(a[0]))
    assert numbers["stage_cost"] == pytest.approx(2.0 * np.sum(error**2) + 0.5 * np.sum(a[0] ** 2))
    field, target = shown.profile()
    assert field.tolist() == z[0].tolist()
    assert target.tolist() == TARGET.tolist()
    assert set(numbers) <= set(VIEW_NUMBERS)


@pytest.mark.parametrize("noise", [(), (3.0,)])  # the column of a plant with noise, or none
def test_costs_are_told_apart_by_the_gains_that_caused_them(noise):
    shown = view()
    lqt = MODEL.policy
    adapted = lqt + 0.1
    begin(
        shown, [np.zeros_like(lqt), lqt, adapted, adapted, adapted], noise=noise, fields=[7.0] * 5
    )
    costs = [(10.0, 100.0, -1), (5.0, 50.0, -1), (4.0, 40.0, -1), (2.0, 20.0, -1), (1e9, 1e10, 3)]
    shown.cost(frame(costs), 0.0)
    for environment, controller in enumerate(("none", "lqt", "adapted")):
        shown.environment = environment
        shown.state(frame(np.zeros((5, N_Z))), 0.0)
        assert shown.controller(shown.current) == controller
    shown.environment = 0
    numbers = shown.numbers()
    assert numbers["cost_no_control"] == 10.0
    assert numbers["cost_lqt"] == 5.0
    assert numbers["cost"] == 3.0  # the one that diverged is no cost
    assert numbers["reduction"] == pytest.approx(40.0)
    shown.environment = 2
    begin(shown, [np.zeros_like(lqt), lqt, adapted], episode=2)
    numbers = shown.numbers()
    assert numbers["gain_norm"] == pytest.approx(np.linalg.norm(adapted))
    assert numbers["gain_change"] == pytest.approx(0.1 * np.sqrt(lqt.size) / np.linalg.norm(lqt))
    shown.cost(frame([(9.0, 90.0, -2)] * 3, episode=2), 0.0)  # void: not a cost
    assert shown.numbers()["cost"] == 3.0


def test_a_reduction_is_that_of_costs_on_the_same_fields():
    shown, lqt = view(), MODEL.policy
    adapted = lqt + 0.1
    begin(shown, [lqt, adapted], fields=(7.0, 7.0))
    shown.cost(frame([(5.0, 50.0, -1), (3.0, 30.0, -1)]), 0.0)
    assert shown.numbers()["reduction"] == pytest.approx(40.0)
    begin(shown, [adapted, adapted], episode=3, fields=(8.0, 9.0))
    shown.cost(frame([(50.0, 500.0, -1), (50.0, 500.0, -1)], episode=3), 0.0)
    assert shown.numbers()["reduction"] == pytest.approx(40.0)
    begin(shown, [lqt, adapted], episode=4, fields=(8.0, 9.0))
    shown.cost(frame([(50.0, 500.0, -1), (1.0, 10.0, -1)], episode=4), 0.0)
    assert shown.numbers()["reduction"] == pytest.approx(40.0)


def test_gains_without_their_model_are_never_taken_for_lqt():
    shown = view()
    lqt = MODEL.policy
    shown.policy(
        frame([lqt], 1, step=2), 0.0
    )  # another generation of models than the one that came
    shown.model(frame(pack(MODEL)[None], 0, step=1), 0.0)
    shown.start(frame([(0, -1.0, 0.0, 0.0)], 1, step=2), 0.0)
    shown.cost(frame([(5.0, 50.0, -1)]), 0.0)
    assert "cost_lqt" not in shown.numbers()
    assert shown.numbers()["cost"] == 5.0


def test_a_finished_episode_is_shown_until_the_next_has_run_for_a_while():
    shown = view()
    for k in range(11):
        shown.state(frame([np.full(N_Z, 1.0)], step=k), 0.0)
    shown.cost(frame([(1.0, 10.0, -1)], step=10), 0.0)
    assert shown.numbers()["final_error"] == pytest.approx(np.sqrt(np.mean((1.0 - TARGET) ** 2)))
    shown.state(frame([np.full(N_Z, -1.0)], episode=2), 5.0)
    red, white = (diverging(shown.space_time(now), (-1.0, 1.0)) for now in (5.1, 7.0))
    assert red.shape == (11, N_Z, 3)
    assert (red[..., 0] > red[..., 2]).all()
    assert (white[0, :, 2] > white[0, :, 0]).all()
    assert (white[1:] == UNSEEN).all()


@pytest.mark.parametrize("horizon", [1, 511, 512, 5000])
def test_a_picture_has_a_row_for_every_step_or_shares_them(horizon):
    shown = LoopView(horizon=horizon)
    for k in range(horizon + 1):
        shown.state(frame([np.full(4, 1.0)], step=k), 0.0)
    rows = shown.space_time(0.0)
    assert len(rows) <= COLUMNS
    per_row = -(-(horizon + 1) // len(rows))
    assert len(rows) == -(-(horizon + 1) // per_row)
    assert not (diverging(rows, (-1.0, 1.0)) == UNSEEN).all(axis=(1, 2)).any()


def test_a_viewer_that_sees_nothing_any_more_is_stale():
    shown = view()
    health = ViewerDiagnostics(shown)
    assert health.report(0.0, 0).message == "nothing seen yet"
    shown.state(frame([np.zeros(N_Z)], step=4), 1.0)
    good = health.report(2.0, 3)
    assert (good.level, good.message) == (Level.OK, "step 4 of episode 1")
    assert good.values["subscribers"] == 3
    assert good.values["samples/s"] == 0.5
    stale = health.report(8.0, 3)
    assert (stale.level, stale.message) == (Level.STALE, "no messages for 7 s")
