# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The live page's pure parts: what is kept, what is told, when the loop is left alone."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import pytest

from loop_interfaces.frames import Frame
from loop_interfaces.grid import Axis, Grid
from loop_interfaces.places import Box, text_of
from loop_interfaces.topics import COMPLETED, VOID
from viewer_node.episode_samples import COLUMNS, MAX_COMPONENTS, ROWS, EpisodeSamples, rows_of
from viewer_node.learning_curve import MAX_POINTS, SENT, LearningCurve
from viewer_node.loop_nodes import Endpoint, LoopNodes
from viewer_node.loop_view import SILENT, SLOW, LoopView
from viewer_node.operation import FAILURE, Call
from viewer_node.rollout_costs import RolloutCosts
from viewer_node.web.page import Page, axes_of, places_of

PLANT = 7


def frame(values: Any, *, step: int = 0, episode: int = 1, run: int = 5, dt: float = 0.1) -> Frame:
    array = np.array(values, dtype=np.float64)
    return Frame(run, episode, step, dt * step, array, PLANT)


def state(step: int, *, batch: int = 2, n_z: int = 4, episode: int = 1, run: int = 5) -> Frame:
    """u = 100 environment + step + point / 10: every number says where it belongs."""
    m, i = np.ogrid[:batch, :n_z]
    return frame(100 * m + step + i / 10, step=step, episode=episode, run=run)


def start(rows: Any, *, episode: int = 1, run: int = 5) -> Frame:
    return frame(rows, episode=episode, run=run)


def cost(
    means: Any, *, ended: int = COMPLETED, episode: int = 1, step: int = 3, run: int = 5
) -> Frame:
    rows = [[mean, step * mean, ended] for mean in means]
    return frame(rows, step=step, episode=episode, run=run)


def unpacked(message: str | bytes) -> tuple[dict[str, Any], np.ndarray]:
    """What the page makes of a message."""
    if isinstance(message, str):
        return json.loads(message), np.empty(0)
    (length,) = struct.unpack_from("<I", message)
    return json.loads(message[4 : 4 + length]), np.frombuffer(message, "<f4", offset=4 + length)


# An episode in a bounded memory.


def test_an_episode_keeps_every_state_and_action_while_there_is_room():
    episode = EpisodeSamples(state(0), environment=1)
    for k in range(10):
        episode.state(state(k))
        episode.action(frame([[k, -k], [10 + k, -k]], step=k))
    assert episode.columns == 10 and episode.stride == 1 and episode.whole
    expected = 100 + np.arange(10)[:, None] + np.arange(4) / 10
    np.testing.assert_allclose(episode.fields[:10], expected, rtol=1e-6)
    np.testing.assert_array_equal(episode.actions[:10, 0], 10 + np.arange(10))
    assert np.isnan(episode.fields[10:]).all()
    assert episode.sample_time == pytest.approx(0.1)


@pytest.mark.parametrize("steps", [COLUMNS, COLUMNS + 1, 3 * COLUMNS + 7, 9 * COLUMNS])
def test_a_long_episode_is_thinned_evenly_and_each_column_shows_a_step_of_its_own(steps):
    episode = EpisodeSamples(state(0))
    for k in range(steps):
        episode.state(state(k))
    stride = episode.stride
    assert stride == 2 ** int(np.ceil(np.log2(steps / COLUMNS)))
    shown = episode.fields[: episode.columns, 0]
    column = np.arange(episode.columns)
    assert (shown // stride == column).all()
    assert shown[-1] == steps - 1
    assert np.isnan(episode.fields[episode.columns :]).all()


def test_missed_steps_stay_blank():
    episode = EpisodeSamples(state(0))
    for k in (0, 1, 5):
        episode.state(state(k))
    assert np.isnan(episode.fields[2:5]).all() and not np.isnan(episode.fields[5]).any()


def test_another_environment_is_shown_from_its_next_state_on():
    view = LoopView()
    view.state(state(0), 0.0)
    view.environment = 7  # of a batch of two the last
    for k in (1, 2):
        view.state(state(k), 0.0)
    shown = view.current
    assert shown.first == 1 and not shown.whole and shown.environment == 1
    np.testing.assert_allclose(shown.fields[:2, 0], [101, 102])
    assert shown.z[-1] == pytest.approx(102.3)


def test_a_state_of_another_batch_or_before_the_first_one_is_left_out():
    episode = EpisodeSamples(state(3))
    episode.state(state(3))
    before = episode.fields.copy()
    episode.state(state(2))
    episode.state(state(4, batch=3))
    np.testing.assert_array_equal(episode.fields, before)
    assert not episode.whole


@pytest.mark.parametrize("components", [1, 2])
@pytest.mark.parametrize("n", [4, ROWS, ROWS + 1, 65536, 1])
def test_rows_are_evenly_spaced_from_the_first_point_of_each_component_to_the_last(n, components):
    rows = rows_of(n * components, components).reshape(components, -1)
    for component, own in enumerate(rows - n * np.arange(components)[:, None]):
        assert len(own) == min(n, ROWS) and own[0] == 0 and own[-1] == n - 1, component
        assert n == 1 or (np.ptp(np.diff(own)) <= 1 and np.diff(own).min() >= 1)


def test_of_very_many_delayed_measurements_the_first_are_kept():
    measured = Frame(5, 1, 0, 0.0, np.arange(3.0 * 1000)[None], PLANT)
    episode = EpisodeSamples(measured, components=1000)
    episode.state(measured)
    assert episode.fields.shape == (COLUMNS, 3 * MAX_COMPONENTS)
    np.testing.assert_array_equal(episode.fields[0, episode.part(1)], [3, 4, 5])
    assert episode.part(999) == episode.part(MAX_COMPONENTS - 1)


def test_a_few_components_are_shown_beside_each_other_each_in_its_own_range():
    page, sent = Page(), {}
    view = page.view
    view.components = ["u", "u_t"]
    view.target(frame([0.0, 0.0, 90.0, 90.0]), 0.0)
    for k in range(3):
        view.state(frame([[k, k, 90, 100]], step=k), 0.0)
    page.refresh(10.0)
    parts = dict(map(part, page.updates(sent, 0.0)))
    assert parts["status"][0]["panels"] == [0, 1]
    np.testing.assert_array_equal(parts["target"][1], [0, 0, 90, 90] * 2)
    header, numbers = parts["episode"]
    assert header["panels"] == [0, 1] and header["rows"] == 2 and header["plane"] is None
    expected = [0, 0, 90, 100, 1, 1, 90, 100, 2, 2, 90, 100]
    np.testing.assert_array_equal(numbers, [*expected, 2, 2, 90, 100, 0, 0, 90, 100])
    (low, high), about = header["ranges"]
    assert low == -high and high == pytest.approx(2.0, abs=0.1)
    assert about == pytest.approx([80.0, 100.0])


def test_of_many_components_one_is_shown_at_a_time():
    page, sent = Page(), {}
    view = page.view
    view.components = [f"y{i}" for i in range(6)]
    view.state(frame([np.repeat(np.arange(6.0), 2)]), 0.0)
    for component in (0, 4):
        assert page.choose({"component": component})
        page.refresh(20.0 + component)
        parts = dict(map(part, page.updates(sent, 0.0)))
        assert parts["status"][0]["component"] == component
        header, numbers = parts["episode"]
        assert header["panels"] == [component]
        np.testing.assert_array_equal(numbers, [component] * 6)


def test_a_field_on_two_axes_is_sent_as_it_is_now_and_was_at_first():
    axes = (Axis("y", 1.0, 2, periodic=False), Axis("x", 1.0, 200))
    grid, page, sent = Grid(axes, ("u", "v")), Page(), {}
    page.take_parameters({"grid": grid.text, "equation": "burgers"})
    view, z = page.view, np.arange(800.0)
    view.components = ["u", "v"]
    view.target(frame(-z), 0.0)
    page.refresh(0.0)
    parts = dict(map(part, page.updates(sent, 0.0)))
    assert "episode" not in parts and parts["target"][0]["plane"] == [2, 96]
    for k in range(3):
        view.state(frame([z + k], step=k), 0.0)
    page.refresh(10.0)
    parts = dict(map(part, page.updates(sent, 0.0)))
    header, numbers = parts["episode"]
    assert header["plane"] == [2, 96] and header["rows"] == 256
    newest, first = numbers[-768:].reshape(2, 2, 2, 96)
    np.testing.assert_array_equal(newest - first, 2.0)
    np.testing.assert_array_equal(first[:, :, [0, -1]], grid.fields(z)[:, :, [0, -1]])
    np.testing.assert_array_equal(np.diff(first[..., 0]), [[200.0], [200.0]])
    np.testing.assert_array_equal(parts["target"][1][:384], -first.ravel())


def test_the_target_is_there_before_the_first_state():
    page, sent = Page(), {}
    page.view.target(frame([1.0, 2.0, 3.0, 4.0]), 0.0)
    parts = dict(map(part, page.updates(sent, 0.0)))
    np.testing.assert_array_equal(parts["target"][1], [1, 2, 3, 4] * 2)
    assert "episode" not in parts


def test_axes_and_places_are_those_that_the_plant_says():
    walls = Grid.interval(2.0, 5, periodic=False)
    cells = Grid.interval(2.0, 4, periodic=False, walls=False)
    for grid, ends in (
        (walls, [0.0, 2.0]),
        (cells, [0.25, 1.75]),
        (Grid.interval(2.0, 4), [0.0, 1.5]),
    ):
        (axis,) = axes_of({"grid": grid.text})
        assert axis == {"label": "x (m)", "length": 2.0, "ends": ends}
    assert axes_of({"grid": Grid.vector(3).text})[0]["label"] == "number"
    for grid, count in ((walls, 2), (cells, 4), (Grid.interval(1.0, 128), 8)):
        (axis,) = axes_of({"grid": grid.text, "sensors": count})
        points = grid.line.points[grid.equally_spaced(count)]
        assert axis["ends"] == pytest.approx([points[0], points[-1]])
    assert axes_of({"length": 3.0})[0]["length"] == 3.0
    boxes = text_of([Box(0, ((0.0, 1.0),))])
    assert places_of({"grid": walls.text, "actuators": boxes})["actuators"] == [
        {"component": 0, "sides": ((0.0, 1.0),)}
    ]
    plane = Grid((Axis("y", 1.0, 2), Axis("x", 1.0, 2))).text
    assert axes_of({"grid": plane, "sensors": 4})[0]["label"] == "sensor"
    for told in (boxes, "", "[[0, [0, NaN]]]", "[[0]]", "7", "<script>"):
        assert places_of({"grid": plane, "actuators": told})["actuators"] == []


# The curve.


def adapted(seed: int, rollouts: int, cost: float | None, **more: Any) -> dict[str, Any]:
    known = {} if cost is None else {"cost": cost}
    return {"event": "adapted", "seed": seed, "rollouts": rollouts, "diverged": 0} | known | more


def points(curve: LearningCurve) -> list[tuple[float, ...]]:
    """What a page is sent: x, mean, low, high."""
    sent = curve.message()
    json.dumps(sent, allow_nan=False)
    return list(zip(*(sent[name] for name in ("x", "mean", "low", "high")), strict=True))


def test_the_band_of_several_seeds_is_over_the_seeds_and_of_one_over_its_rollouts():
    several, one = LearningCurve(), LearningCurve()
    for seed, value in enumerate((1.0, 2.0, 6.0)):
        several.row(adapted(seed, 2, value, cost_plus=value + 9, cost_minus=value - 9))
    one.row(adapted(0, 2, 2.0, cost_plus=2.5, cost_minus=1.5))
    assert points(several) == [(2, 3.0, 1.0, 6.0)] and several.message()["band"] == "seeds"
    assert points(one) == [(2, 2.0, 1.5, 2.5)] and one.message()["band"] == "rollouts"


def test_seeds_that_are_at_other_rollouts_keep_their_cost_until_their_next_point():
    curve = LearningCurve()
    for seed, rollouts, value in ((0, 3, 4.0), (1, 4, 2.0), (0, 5, 3.0), (1, 9, 1.0)):
        curve.row(adapted(seed, rollouts, value))
    assert points(curve) == [(3, 4, 4, 4), (4, 3, 2, 4), (5, 2.5, 2, 3), (9, 2, 1, 3)]
    assert curve.message()["costs"] == [[4, 4, 3, 3], [None, 2, 2, 1]]
    curve.row(adapted(0, 5, 3.5))  # a tuner that was killed repeats what it had not kept
    assert points(curve)[2] == (5, 2.75, 2, 3.5)


def test_what_diverged_has_no_point_and_broken_lines_are_left_out():
    curve = LearningCurve()
    curve.row(adapted(0, 2, None, diverged=2))
    for line in ({}, {"event": "adapted"}, {"event": "adapted", "seed": "x", "rollouts": 1}):
        curve.row(line)
    assert (
        points(curve) == []
        and curve.message()["diverged"] == 2
        and curve.message()["paid"] == [2, 2]
    )


def test_references_are_those_of_the_evaluation_alone_as_all_others_are_on_other_fields():
    curve = LearningCurve()
    curve.row({"event": "checked", "seed": 0, "none": 9.0, "lqt": 99.0, "accepted": False})
    assert curve.references == {}
    for seed, lqt in ((0, 2.0), (1, 4.0)):
        curve.row({"event": "checked", "seed": seed, "none": 9.0, "lqt": lqt, "accepted": True})
    assert curve.references == {} and curve.checked == {"none": 9.0, "lqt": 3.0}
    curve.row({"event": "evaluated", "seed": 0, "none": 8.0, "lqt": 2.5, "adapted": 1.5})
    assert curve.references == {"none": 8.0, "lqt": 2.5, "adapted": 1.5}
    assert curve.evaluations == {0: {"none": 8.0, "lqt": 2.5, "adapted": 1.5}}


def test_a_long_training_stays_within_bounds():
    curve = LearningCurve()
    for k in range(1, 3 * MAX_POINTS):
        curve.row(adapted(0, k, 1.0))
    xs = curve.message()["x"]
    assert len(xs) <= SENT and xs[-1] == 3 * MAX_POINTS - 1
    assert len(curve._points[0]) <= MAX_POINTS


def test_the_time_that_is_left_follows_from_the_rollouts_of_the_last_minute():
    curve = LearningCurve()
    assert curve.remaining(0.0) is None
    for seed in (0, 1):
        curve.row({"event": "designed", "seed": seed})
    # One seed was explored more often: what it has paid before is no speed.
    paid = {"budget": [100, 100], "rollouts": [0, 50], "time": 0.0}
    curve.row({"event": "phase", "phase": "adapt", **paid})
    assert curve.message()["paid"] == [0, 50] and curve.seeds == [0, 1]
    for k in range(1, 31):  # ten seconds each at first, then one
        now = 10.0 * min(k, 10) + max(0, k - 10)
        curve.row(adapted(0, k, 1.0, time=now))
        curve.row(adapted(1, 50 + k, 1.0, time=now))
    rate = 2 * (30 - 6) / 60.0
    assert curve.remaining(120.0) == pytest.approx((70 + 20) / rate, rel=0.05)
    assert curve.remaining(130.0) == pytest.approx(curve.remaining(120.0) - 10.0)
    assert curve.remaining(1e4) is None  # nothing has come for longer than that
    curve.row({"event": "phase", "phase": "evaluate", **paid})
    assert curve.remaining(130.0) is None


def test_from_the_topics_alone_policies_are_points_and_all_three_controllers_an_evaluation():
    curve, costs = LearningCurve(), RolloutCosts()
    acts = [[3, -1, 0, 0], [3, -1, 0, 0], [4, -1, 0, 1], [4, -1, 0, 1]]

    def episode(rows: Any, gains: Any, means: list[float], ended: int = COMPLETED) -> None:
        costs.start(start(rows))
        costs.policy(frame(gains))
        curve.episode(costs.cost(cost(means, ended=ended)))

    gains = np.ones((4, 2, 3))
    episode(acts, gains, [1.0, 3.0, 5.0, 7.0])
    assert points(curve) == [(1, 4.0, 2.0, 6.0)]
    gains = gains.copy()
    gains[:2] = 0.0
    episode(acts, gains, [8.0, 10.0, 1.0, 1.0])
    assert curve.references == {} and len(points(curve)) == 1  # LQT's law is not known
    episode([[3, 17, 0.1, 0]], gains, [50.0])
    assert len(points(curve)) == 1 and curve.phase == "identify"
    episode(acts, np.ones((4, 2, 3)), [1e9, 1e9, 2.0, 2.0], ended=12)
    assert len(points(curve)) == 1 and curve.message()["diverged"] == 4


def test_episodes_that_come_in_at_once_are_a_point_each():
    view = LoopView()
    for episode in (1, 2, 3):
        view.policy(frame(np.ones((2, 2, 3)), episode=episode), 1.0)
    for episode in (1, 2, 3):
        view.start(start([[3, -1, 0, 0], [4, -1, 0, 0]], episode=episode), 1.0)
    view.start(frame(np.empty((0, 4)), episode=0), 1.0)
    for episode in (1, 2, 3):
        view.cost(cost([episode, episode + 2.0], episode=episode), 1.0)
    three = [(1, 2.0), (2, 3.0), (3, 4.0)]
    assert [point[:2] for point in points(view.curve)] == three
    view.cost(cost([9.0, 9.0], episode=4), 1.0)  # nobody knows what it was
    view.start(start([[3, -1, 0, 0]], episode=5), 1.0)
    view.policy(frame(np.ones((1, 2, 3)), episode=5), 1.0)
    view.cost(cost([9.0], episode=5, ended=VOID), 1.0)
    assert len(points(view.curve)) == 3


# Nodes.


def test_a_node_that_comes_again_is_counted_and_one_that_is_only_seen_late_is_not():
    nodes = LoopNodes()
    first, second = Endpoint("/pde_sim_node", b"a"), Endpoint("/pde_sim_node", b"b")
    for found in ([first], [], [first], [first, second], [second]):
        nodes.update({"plant": found})
    (plant, controller, _) = nodes.message(0.0)
    assert plant["restarts"] == 1 and plant["present"] and plant["rivals"] == 0
    assert not controller["present"] and controller["name"] == ""


def test_diagnostics_belong_to_the_node_they_name_and_are_forgotten_when_they_stop():
    nodes = LoopNodes()
    nodes.update({"plant": [Endpoint("/lab/pde_sim_node", b"a")]})
    values = [("paused", "yes"), ("step", "4")]
    nodes.diagnosis("lab/pde_sim_node: lock-step", 1, "paused", values, 10.0)
    nodes.diagnosis("lab/other: lock-step", 2, "no", [], 10.0)
    assert nodes.message(11.0)[0]["message"] == "paused" and nodes.message(11.0)[0]["level"] == 1
    assert nodes.value("plant", "paused") == "yes" and nodes.value("plant", "phase") is None
    assert "message" not in nodes.message(30.0)[0]


def test_a_rate_is_that_of_the_last_seconds():
    page, rates = Page(), []
    for tick in range(200):
        page.view.rounds += 50 * (tick < 100)
        page.refresh(0.5 * tick)
        rates.append(json.loads(page.updates({}, 0.0)[0])["rounds"])
    assert rates[99] == pytest.approx(100.0, rel=0.01) and rates[-1] == 0.0


# What is watched.


def test_the_last_whole_episode_is_shown_until_the_next_has_run_for_a_while():
    view = LoopView()
    for k in (5, 6):
        view.state(state(k, episode=1), 0.0)
    assert view.shown(0.0).first == 5  # better than nothing
    view.state(state(0, episode=2), 0.1)
    assert view.shown(0.1).key[1] == 2
    view.cost(cost([1.0, 1.0], episode=2), 0.2)
    view.state(state(7, episode=3), 0.3)
    view.cost(cost([1.0, 1.0], episode=3), 0.4)  # the end alone does not replace a whole one
    assert view.shown(0.4 + SLOW).key[1] == 2
    view.state(state(0, episode=4), 0.5)
    assert view.shown(0.5).key[1] == 2
    assert view.shown(0.6 + SLOW).key[1] == 4  # a plant that is held in the middle of an episode


def test_a_plant_that_begins_the_same_episode_again_is_shown_from_the_beginning():
    view = LoopView()
    for k in (0, 0, 1, 2):  # the first is repeated: that is no new beginning
        view.state(state(k), 0.0)
    first = view.current
    assert first is not None and first.last == 2
    view.state(state(0), 1.0)
    assert view.current is not first and view.current.last == 0


def test_rounds_are_counted_though_only_some_are_seen():
    view = LoopView()
    for episode in range(1, 31):
        view.start(start([[0, -1, 0, 0]], episode=episode), 0.1 * episode)
        view.cost(cost([1.0], episode=episode, step=50), 0.1 * episode)
        view.cost(cost([1.0], episode=episode, step=50), 0.1 * episode)  # repeated
    assert view.rounds == 30 * 50
    assert view.episodes == 30


def test_only_the_asked_run_is_shown():
    view = LoopView(only=5)
    view.state(state(0, run=6), 0.0)
    assert view.current is None
    view.state(state(0, run=5), 0.0)
    assert view.current is not None


def test_who_is_paused_is_what_the_plant_and_the_diagnostics_say():
    view = LoopView()
    roles = {"plant": [Endpoint("/p", b"p")], "tuner": [Endpoint("/t", b"t")]}
    view.nodes.update(roles)
    view.state(state(0), 0.0)
    assert view.state_of_loop(0.1) == "running" and view.state_of_loop(9.0) == "silent"
    view.paused(frame([1.0]), 1.0)
    assert view.operation.paused(1.0) == ["plant"] and view.state_of_loop(1.0) == "paused"
    view.paused(frame([0.0]), 1.0)
    view.nodes.diagnosis("t: training", 1, "", [("paused", "yes")], 2.0)
    assert view.operation.paused(1.0) == ["tuner"]
    view.nodes.update({"plant": [Endpoint("/p", b"p")]})
    assert view.operation.paused(2.0) == []  # who is gone is not paused
    view.nodes.update(roles)
    computing = [("paused", "yes"), ("activity", "fitting models"), ("activity for", "1.0")]
    view.nodes.diagnosis("t: training", 0, "", computing, 2.5)  # resumed, and busy since then
    assert view.operation.paused(2.5) == []
    view.nodes.diagnosis("t: training", 0, "", [("paused", "no")], 3.0)
    assert view.operation.paused(2.0) == []
    view.start(frame(np.empty((0, 4))), 9.0)
    assert view.state_of_loop(9.0) == "ended"


def test_what_was_asked_for_is_told_until_it_is_answered_and_a_failure_for_a_while():
    view = LoopView()
    view.nodes.update({"tuner": [Endpoint("/t", b"t")]})
    pause, stop = Call("/t", "pause"), Call("/t", "stop")
    view.operation.asked(pause, 1.0)
    asked = {"role": "tuner", "verb": "pause", "seconds": 7, "failure": ""}
    assert view.operation.requests(8.0) == [asked]
    view.operation.answered(pause, 8.0, None)
    assert view.operation.requests(8.0) == []
    view.operation.answered(pause, 9.0, "no")
    assert [r["failure"] for r in view.operation.requests(9.0 + FAILURE)] == ["no"]
    assert view.operation.requests(9.1 + FAILURE) == []
    view.operation.asked(stop, 30.0)
    assert not view.operation.stopping
    view.operation.answered(stop, 31.0, None)
    assert view.operation.stopping
    view.operation.asked(pause, 32.0)
    view.nodes.update({"tuner": [Endpoint("/t", b"u")]})  # another one, that continues the run
    assert not view.operation.stopping
    view.nodes.update({})
    assert view.operation.requests(33.0) == []  # nobody is there who could answer


def test_an_activity_is_told_with_its_seconds_while_its_node_reports_it():
    nodes = LoopNodes()
    nodes.update({"tuner": [Endpoint("/t", b"t")]})
    assert nodes.activity(0.0) is None
    values = [("activity", "fitting models"), ("activity for", "5.0")]
    nodes.diagnosis("t: training", 0, "fitting models for 5 s", values, 10.0)
    told = {"role": "tuner", "what": "fitting models", "seconds": 7}
    assert nodes.activity(12.0) == told
    assert nodes.activity(20.0) is None
    nodes.diagnosis("t: training", 0, "adapt", [("phase", "adapt")], 21.0)
    assert nodes.activity(21.0) is None


def test_a_loop_that_is_gone_without_a_word_has_ended_too():
    view = LoopView()
    assert view.state_of_loop(0.0) == "empty"
    view.nodes.update({"plant": [Endpoint("/p", b"p")]})
    view.state(state(0), 0.0)
    assert view.state_of_loop(0.1) == "running"
    view.nodes.update({})
    assert view.state_of_loop(0.2) == "running"  # it was we who were held up
    assert view.state_of_loop(SILENT) == "ended"
    view.nodes.update({"plant": [Endpoint("/p", b"q")]})
    view.state(state(1), 9.0)
    assert view.state_of_loop(9.0) == "running"


# The messages to a page.


def test_a_page_is_sent_the_whole_episode_whenever_something_of_it_is_new():
    page, sent = Page(environment=1), {}
    view = page.view
    for k in range(50):
        view.state(state(k), 0.0)
        if k != 20:  # an action that never comes
            view.action(frame([[k, 0], [100 + k, 0]], step=k), 0.0)
        if k % 7 == 3 or k == 49:
            parts = dict(map(part, page.updates(sent, 0.0)))
            header, numbers = parts["episode"]
            assert (header["columns"], header["rows"], header["actions"]) == (k + 1, 4, 2)
            ends = np.cumsum([4 * (k + 1), 2 * (k + 1), 4])
            field, actions, newest, first = np.split(numbers, ends)
            expected = 100 + np.arange(k + 1)[:, None] + np.arange(4) / 10
            np.testing.assert_allclose(field.reshape(-1, 4), expected, rtol=1e-6)
            np.testing.assert_allclose(newest, expected[-1], rtol=1e-6)
            np.testing.assert_allclose(first, expected[0], rtol=1e-6)
            acted = 100.0 + np.arange(k + 1)
            acted[20:21] = np.nan
            np.testing.assert_array_equal(actions[::2], acted)
            assert page.updates(sent, 0.0) == []


def part(message: str | bytes) -> tuple[str, tuple[dict[str, Any], np.ndarray]]:
    """A message by the name of the part of the page that it is about."""
    header, numbers = unpacked(message)
    return header["part"], (header, numbers)


def test_the_chosen_environment_and_another_loop_are_sent():
    page, sent = Page(environment=1), {}
    view = page.view
    view.target(frame([1.0, 2.0, 3.0, 4.0]), 0.0)
    for k in range(5):
        view.state(state(k), 0.0)
    parts = dict(map(part, page.updates(sent, 0.0)))
    np.testing.assert_array_equal(parts["target"][1], [1, 2, 3, 4] * 2)  # drawn, and by column
    header, numbers = parts["episode"]
    assert header["environment"] == 1 and numbers[0] == 100
    view = LoopView()
    page.show(view, domain=3, namespace="/")
    page.refresh(0.0)
    view.state(state(0), 0.0)
    headers = [unpacked(message)[0] for message in page.updates(sent, 0.0)]
    assert [h["part"] for h in headers] == ["status", "curve", "target", "episode"]
    assert headers[-1]["columns"] == 1 and headers[-1]["environment"] == 1
    assert headers[0]["place"]["domain"] == 3


def test_the_colours_span_the_field_and_the_target_and_do_not_flicker():
    page, sent = Page(), {}
    view = page.view
    view.target(frame([-10.0, 0.0, 0.0, 0.0]), 0.0)

    def colours(k: int) -> Any:
        view.state(state(k), 0.0)
        page.refresh(10.0 * k)
        (limits,) = unpacked(page.updates(sent, 0.0)[-1])[0]["ranges"]
        return limits

    first = colours(0)
    assert first == [-10.0, 10.0]
    assert colours(1) == first
    assert colours(90)[1] > 80
