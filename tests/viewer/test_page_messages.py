# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A page is sent what is new of an episode, its target and its axes."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import pytest

from pdeloop.messages.actuators import Box, text_of
from pdeloop.messages.cost import Cost
from pdeloop.messages.grid import Axis, Grid
from pdeloop.monitor.node import component_names
from tests.support.viewed import frame, state
from viewer_node.loop_view import LoopView
from viewer_node.web.page import Page, axes_of, bounds_of, path_of, places_of


def unpacked(message: str | bytes) -> tuple[dict[str, Any], np.ndarray]:
    """What the page makes of a message."""
    if isinstance(message, str):
        return json.loads(message), np.empty(0)
    (length,) = struct.unpack_from("<I", message)
    return json.loads(message[4 : 4 + length]), np.frombuffer(message, "<f4", offset=4 + length)


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
    page.take_parameters({"grid": grid.text, "actuators": "[]"})
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


def test_fields_of_different_lengths_have_a_panel_each():
    grid, page, sent = Grid(fields={"depth": (0, 3), "flow": (3, 5)}), Page(), {}
    page.take_parameters({"grid": grid.text, "actuators": "[]"})
    view, z = page.view, np.arange(5.0)
    view.components = component_names({"grid": grid.text})
    assert view.components == ["depth", "flow"]
    view.target(frame(-z), 0.0)
    view.state(frame([z]), 0.0)
    page.refresh(0.0)
    parts = dict(map(part, page.updates(sent, 0.0)))
    header, numbers = parts["episode"]
    assert header["panels"] == [0, 1] and header["rows"] == 3
    np.testing.assert_array_equal(numbers[:6], [0, 1, 2, 3, 3, 4])
    np.testing.assert_array_equal(parts["target"][1][:6], [0, -1, -2, -3, -3, -4])


def test_the_target_is_there_before_the_first_state():
    page, sent = Page(), {}
    page.view.target(frame([1.0, 2.0, 3.0, 4.0]), 0.0)
    parts = dict(map(part, page.updates(sent, 0.0)))
    np.testing.assert_array_equal(parts["target"][1], [1, 2, 3, 4] * 2)
    assert "episode" not in parts


def test_of_a_plant_that_tells_no_parameters_no_other_node_says_where_and_how_long():
    page = Page()
    page.take_parameters({"problem": "arm", "n_a": 1, "length": 1.0, "grid": "", "horizon": 300})
    assert page.parameters == {"problem": "arm", "n_a": 1} and page.view.horizon == 0
    page.take_parameters({"actuators": "[]", "length": 2.0, "grid": "", "horizon": 50})
    assert page.parameters["axes"][0]["length"] == 2.0 and page.view.horizon == 50


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


def test_a_rate_is_that_of_the_last_seconds():
    page, rates = Page(), []
    for tick in range(200):
        page.view.rounds += 50 * (tick < 100)
        page.refresh(0.5 * tick)
        rates.append(json.loads(page.updates({}, 0.0)[0])["rounds"])
    assert rates[99] == pytest.approx(100.0, rel=0.01) and rates[-1] == 0.0


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


def test_the_bounds_of_each_actuator_are_told_as_the_plant_says_them():
    page = Page()
    page.take_parameters({"n_a": 2, "actuators": "[]", "action_limit": 3.0})
    assert page.parameters["bounds"] == {"low": [-3.0, -3.0], "high": [3.0, 3.0]}
    bounds = [0.0, -1e300, 4.0, 1e300, 0.0]
    page.take_parameters(
        {"n_a": 2, "actuators": "[]", "action_limit": 0.0, "action_bounds": bounds}
    )
    assert page.parameters["bounds"] == {"low": [0.0, -3.0], "high": [3.0, 3.0]}
    json.dumps(page.parameters, allow_nan=False)
    assert bounds_of({"n_a": 2, "action_bounds": bounds}) == {
        "low": [0.0, None],
        "high": [4.0, None],
    }
    for told in ({}, {"n_a": 2}, {"n_a": 2, "action_bounds": [1.0]}, {"n_a": "x"}):
        assert bounds_of(told) is None


def test_a_moving_target_is_sent_once_for_all_columns_and_as_it_is_at_the_newest_step():
    rows = np.arange(32.0).reshape(8, 4)
    told = {"n_a": 1, "actuators": "[]", "cost": Cost(4, 1, 8, target=rows).texts, "horizon": 8}
    page, sent = Page(), {}
    page.take_parameters(told)
    page.view.target(frame(rows[0]), 0.0)
    for k in range(3):
        page.view.state(frame([np.zeros(4)], step=k), 0.0)
    page.refresh(10.0)
    parts = dict(map(part, page.updates(sent, 0.0)))
    header, numbers = parts["path"]
    assert (header["columns"], header["begin"], header["stride"]) == (9, 0, 1)
    # Beyond its last row the target stays where it is.
    np.testing.assert_array_equal(numbers.reshape(9, 4), rows[[0, 1, 2, 3, 4, 5, 6, 7, 7]])
    np.testing.assert_array_equal(parts["target"][1], [*rows[2], *rows[2]])
    page.view.state(frame([np.zeros(4)], step=3), 0.0)
    parts = dict(map(part, page.updates(sent, 0.0)))
    assert "path" not in parts
    np.testing.assert_array_equal(parts["target"][1], [*rows[3], *rows[3]])
    error = float(np.sqrt(np.mean(rows[3] ** 2)))
    assert page.view.numbers()["tracking_error"] == pytest.approx(error)
    assert path_of({"cost": Cost(4, 1, 8, target=rows[0]).packed}) is None
    assert path_of({"cost": ["{"]}) is None and path_of({}) is None


def test_what_answers_the_last_state_is_not_shown_as_an_applied_action():
    page, sent = Page(), {}
    page.take_parameters({"n_a": 1, "actuators": "[]", "horizon": 2})
    for k in range(3):
        page.view.state(frame([np.zeros(4)], step=k), 0.0)
        page.view.action(frame([[1.0]], step=k), 0.0)
    page.refresh(10.0)
    header, numbers = dict(map(part, page.updates(sent, 0.0)))["episode"]
    actions = numbers[12 : 12 + header["columns"] * header["actions"]]
    np.testing.assert_array_equal(actions, [1.0, 1.0, np.nan])
