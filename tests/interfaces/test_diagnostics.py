# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What the nodes say of themselves: levels and values by what has happened to them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from rclpy.qos import QoSProfile

import controller_node.node
import pde_sim_node.node
from controller_node.diagnostics import ControllerDiagnostics
from controller_node.identification import DesignSettings
from controller_node.responder import Responder
from pde_sim_node.build import build_plant
from pde_sim_node.diagnostics import PlantDiagnostics
from pde_sim_node.real_time import Timing
from pdeloop.messages.diagnostics import Level, Rate, Status
from pdeloop.messages.frames import Frame
from pdeloop.messages.parameters import taken_by
from pdeloop.messages.topics import COST, STATE, TARGET, VOID
from pdeloop.ros import introspection
from pdeloop.ros.endpoints import reader_qos, writer_qos
from pdeloop.ros.introspection import Introspection
from tests.support.lockstep import RUN, answer, plant_protocol, run_episode, start
from tests.support.small import parameters
from tests.tuner.test_session import ITERATIONS, Loop, values
from tuner_node.build import build_training
from tuner_node.diagnostics import TunerDiagnostics


def test_texts_and_worse_levels():
    health = Status(Level.OK, "fine", {"a": 1 / 3, "b": True, "c": None, "d": 2**40})
    assert health.texts() == [("a", "0.333333"), ("b", "yes"), ("c", ""), ("d", "1099511627776")]
    worse = health.merged(Level.WARN, "odd")
    assert (worse.level, worse.message) == (Level.WARN, "odd")
    worst = worse.merged(Level.ERROR, "broken").merged(Level.WARN, "odd again")
    assert (worst.level, worst.message) == (Level.ERROR, "odd; broken; odd again")


def test_a_publisher_whose_messages_do_not_arrive_is_named_with_its_topic():
    """DDS connects no volatile publisher to a reader that asks for transient local."""
    offered = {"/lab/mine": QoSProfile(depth=1), "/": writer_qos(TARGET)}
    there = [
        SimpleNamespace(node_namespace="/lab", node_name="mine", qos_profile=offered["/lab/mine"]),
        SimpleNamespace(node_namespace="/", node_name="good", qos_profile=offered["/"]),
    ]
    node = MagicMock()
    node.count_publishers.return_value = 2
    node.get_publishers_info_by_topic.return_value = there
    node.count_services.return_value = 1
    found = Introspection(node)
    found.supervise("/target", reader_qos(TARGET))
    found.round(1.0)
    ((said,), _) = node.get_logger().error.call_args
    assert said.startswith(
        "/lab/mine publishes /target, but its messages cannot arrive (QoS: Volatile"
    )
    assert node.get_logger().error.call_count == 1
    assert found.several_publishers == {"/target": ["/good", "/lab/mine"]}


def test_every_topic_with_a_wrong_publisher_is_named_and_again_while_it_lasts(monkeypatch):
    monkeypatch.setattr(introspection, "is_confined", lambda: True)
    node, lone = MagicMock(), SimpleNamespace(node_namespace="/", node_name="mine")
    lone.qos_profile = QoSProfile(depth=1)
    node.count_publishers.return_value = 1
    node.get_publishers_info_by_topic.return_value = [lone]
    node.count_services.return_value = 1
    found = Introspection(node)
    for topic in ("/target", "/policy", "/model"):
        found.supervise(topic, reader_qos(TARGET))
    found.round(1.0)
    said = [call.args[0].split()[2].rstrip(",") for call in node.get_logger().error.call_args_list]
    assert said == ["/target", "/policy", "/model"]
    node.count_publishers.return_value = 2
    node.get_publishers_info_by_topic.return_value = [lone, lone]
    for now in range(2, 32):
        found.round(float(now))
    assert node.get_logger().error.call_count == 3 * 4
    warned = [call.args[0] for call in node.get_logger().warning.call_args_list]
    assert len(warned) == 3 * 3
    assert warned[0].startswith("several nodes publish /target: /mine (2 nodes of this name); only")


def test_a_node_that_was_started_again_is_not_two_of_its_name(monkeypatch):
    monkeypatch.setattr(introspection, "is_confined", lambda: True)
    node, there = MagicMock(), SimpleNamespace(node_namespace="/", node_name="mine")
    there.qos_profile = writer_qos(TARGET)
    node.count_services.return_value = 1
    found = Introspection(node)
    found.supervise("/target", reader_qos(TARGET))
    for now in range(40):
        count = 2 if now % 10 < 5 else 1  # one that was killed is seen for a while
        node.count_publishers.return_value = count
        node.get_publishers_info_by_topic.return_value = [there] * count
        found.round(float(now))
    assert not node.get_logger().warning.called and found.several_publishers == {}


@pytest.mark.parametrize(
    "module", [controller_node.node, pde_sim_node.node], ids=lambda m: m.__name__
)
def test_a_node_is_not_there_before_it_can_answer(module, monkeypatch):
    """Its publishers are what it is known by; what it compiles may take long."""

    class CompilingError(Exception):
        pass

    loop = MagicMock()
    own = {spec.name for spec in taken_by(module.__name__.split(".")[0])} | {"problem"}
    known = {name: value for name, value in parameters().items() if name in own}
    if module is controller_node.node:
        kind = module.ControllerNode
        monkeypatch.setattr(module, "declare", lambda *given: known)
    else:
        kind, declared = module.PlantNode, (build_plant(parameters()), known)
        monkeypatch.setattr(module, "declare_parameters", lambda *given: declared)
    monkeypatch.setattr(module.FAST_PATH, "load_compiled", MagicMock(side_effect=CompilingError))
    monkeypatch.setattr(module, "given_parameters", lambda node, package: {})
    with pytest.raises(CompilingError):
        kind(MagicMock(), loop)
    assert not loop.sender.called and not loop.receive.called


def test_a_rate_is_the_growth_since_the_last_look():
    rate = Rate()
    assert rate.per_second(100, 1.0) == 0.0
    assert rate.per_second(150, 3.0) == 25.0
    assert rate.per_second(150, 4.0) == 0.0


def test_a_plant_is_ready_runs_is_overdue_is_paused_and_is_void():
    protocol = plant_protocol()
    health = PlantDiagnostics(protocol)
    idle = health.report(0.0)
    assert (idle.level, idle.message) == (Level.OK, "no run; ready for one")
    assert idle.values["run"] is None
    assert idle.values["last cost"] is None
    (send,) = protocol.start(start(1), 0.0)
    for _ in range(10):
        (send,) = protocol.action(answer(send.frame), 0.0)
    running = health.report(1.0)
    assert (running.level, running.message) == (Level.OK, "step 10 of episode 1")
    assert running.values["steps/s"] == 10.0
    assert running.values["environment steps/s"] == 20.0
    assert (running.values["horizon"], running.values["environments"]) == (30, 2)
    protocol.action(replace(answer(send.frame), step=13), 1.0)  # too early
    assert health.report(2.0).values["stale messages"] == 1
    protocol.pause(2.0)
    paused = health.report(3.0)
    assert (paused.level, paused.message) == (Level.WARN, "paused at step 10 of episode 1")
    protocol.resume(3.0)
    slow = plant_protocol()
    slow.adjust(0.0, Timing(action_timeout=1.0, max_repeats=3, run_hold=10.0))
    slow.start(start(1), 0.0)
    slow_health = PlantDiagnostics(slow)
    for now in (1.1, 2.2, 3.3):
        slow.tick(now)
    overdue = slow_health.report(3.5)
    assert overdue.level is Level.WARN
    assert "no action for step 0 of episode 1" in overdue.message
    slow.tick(5.0)
    void = slow_health.report(5.0)
    assert void.level is Level.ERROR
    assert "episode 1 is void" in void.message
    assert void.values["episodes void"] == 1
    assert void.values["last cost"] is None


def test_a_plant_tells_the_cost_of_the_environments_that_completed():
    protocol = plant_protocol()
    health = PlantDiagnostics(protocol)
    cost = run_episode(protocol, 1)[-1]
    done = health.report(0.0)
    assert done.values["last cost"] == cost.values[:, 0].mean()
    (send,) = protocol.start(start(2), 0.0)
    while send.topic is STATE:
        reply = answer(send.frame)
        if send.frame.step == 3:
            reply.values[0] = 1e9
        (send,) = protocol.action(reply, 0.0)
    assert send.topic is COST
    after = health.report(1.0)
    assert after.values["last diverged"] == 1
    assert after.values["last cost"] == send.frame.values[1, 0]


def test_states_that_are_late_for_real_time_are_a_warning_once():
    protocol = plant_protocol()
    protocol.adjust(
        0.0, Timing(action_timeout=0.5, max_repeats=3, run_hold=10.0, real_time_factor=1.0)
    )
    health = PlantDiagnostics(protocol)
    (send,) = protocol.start(start(1), 0.0)
    protocol.action(answer(send.frame), 0.3)  # due at 0.05
    (send,) = protocol.tick(0.3)
    late = health.report(0.3)
    assert late.level is Level.WARN
    assert "1 state too late for real time" in late.message
    assert health.report(0.35).level is Level.OK


def responder() -> Responder:
    return Responder(DesignSettings(n_a=2, reduced_order=2, state_weight=1.0, action_weight=1.0))


def exploration(episode: int) -> Frame:
    return Frame(RUN, episode, 0, 0.0, np.array([[1.0, 5.0, 0.1, 0.0]]))


def test_a_controller_waits_answers_grows_stale_and_is_at_rest():
    controller = responder()
    health = ControllerDiagnostics(controller)
    assert health.report(0.0).message == "no episode under way"
    state = Frame(RUN, 1, 0, 0.0, np.ones((1, 8)), 9)
    controller.state(state)
    assert health.waiting(0.0) == []
    waiting = health.report(2.5)
    assert waiting.level is Level.WARN
    assert waiting.message.endswith("still missing: episode/start, target")
    controller.start(exploration(1))
    controller.target(Frame(0, 0, 0, 0.0, np.zeros(8), 9))
    running = health.report(3.0)
    assert (running.level, running.message) == (Level.OK, "step 0 of episode 1")
    assert running.values["exploring"] is True
    assert running.values["answers/s"] == 2.0  # one in half a second
    stale = health.report(9.0)
    assert stale.level is Level.STALE
    assert stale.message == "no state for 6 s, after step 0 of episode 1"
    health.plant_paused = True
    assert health.report(10.0).level is Level.OK
    health.plant_paused = False
    controller.cost(Frame(RUN, 1, 0, 0.0, np.array([[0.5, 5.0, VOID]]), 9))
    assert health.report(20.0).message.startswith("no reduced model: the exploratory episode")
    controller.start(exploration(2))
    for step in range(6):
        controller.state(Frame(RUN, 2, step, 0.0, np.ones((1, 8)), 9))
    assert health.report(21.0).level is Level.OK
    controller.cost(Frame(RUN, 2, 5, 0.0, np.array([[0.5, 5.0, 3.0]]), 9))
    controller.failure, kept = "", controller.failure
    health.plants = 1
    assert health.report(22.0).message == "no episode under way"
    health.plants = 0
    assert health.report(23.0).level is Level.OK
    gone = health.report(28.0)
    assert gone.level is Level.STALE
    assert gone.message == "no state for 7 s, after step 5 of episode 2; the plant is gone"
    controller.failure = kept
    failed = health.report(28.0)
    assert failed.level is Level.ERROR
    assert "diverged under exploration" in failed.message
    assert failed.values["identifications failed"] == 2


def test_a_tuner_tells_how_far_it_is_who_is_missing_and_what_holds_it():
    loop = Loop(build_training(values()))
    health = TunerDiagnostics(loop.session)
    first = health.report(0.0)
    assert (first.level, first.message) == (Level.OK, "identify")
    while loop.iterations() < 2:
        loop.episode()
    told = health.report(10.0)
    paid, budget = (sum(counts) for counts in loop.session.training.progress.values())
    assert budget - paid == 2 * 2 * (ITERATIONS - 2)  # of two seeds
    where = f"rollout {paid} of {budget}"
    assert (told.level, told.message) == (Level.OK, where)
    assert told.values["rollouts/s"] == pytest.approx(paid / 10)
    history = loop.session.training.history
    assert told.values["adapted cost"] == history[-1]["cost"]
    checked = [row for row in loop.rows if row["event"] == "checked"]
    last = {row["seed"]: row["lqt"] for row in checked}
    assert told.values["cost with LQT"] == pytest.approx(np.mean(list(last.values())))
    dispatcher = loop.session.dispatcher
    loop.handle(dispatcher.presence(0, ["plant", "controller"], 11.0))
    assert health.report(11.0).level is Level.OK  # it takes a moment to find them
    absent = health.report(12.5)
    assert absent.level is Level.WARN
    assert absent.message == "waiting for plant and controller"
    loop.handle(dispatcher.presence(0, [], 12.5))
    frame = loop.start
    void = np.full((len(frame.values), 3), float(VOID))
    loop.handle(dispatcher.cost(0, Frame(7, frame.episode, 3, 0.0, void, 1), 0.0))
    repeated = health.report(13.0)
    assert repeated.level is Level.WARN
    assert "an episode had to be repeated" in repeated.message
    assert repeated.values["episodes repeated"] == 1
    assert health.report(30.0).level is Level.OK
    dispatcher.pause()
    assert health.report(31.0).message == f"paused in {where}"
    loop.handle(dispatcher.resume(31.0))
    dispatcher.plant_paused(0, Frame(7, 1, 0, 0.0, np.array([1.0]), 1), 31.0)
    assert health.report(32.0).message == f"the plant is paused in {where}"
    assert health.report(32.0).values["paused plants"] == 1
    assert health.report(50.0).values["paused plants"] == 0
    loop.session.stop()
    assert health.report(50.0).message.endswith("stopping after it")
    restarted = Loop(build_training(values()), incarnation=3)
    assert TunerDiagnostics(restarted.session).report(0.0).values["restarts"] == 3
