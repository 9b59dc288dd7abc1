# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What is known of a loop: its nodes, the episode that is shown, who is paused, what was asked for."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.viewed import cost, frame, start, state
from viewer_node.loop_nodes import FAILURE, Call, Endpoint, LoopNodes
from viewer_node.loop_view import SILENT, SLOW, LoopView


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
