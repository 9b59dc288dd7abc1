# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What ROS tools see of the running nodes: diagnostics, parameters, time, names."""

from __future__ import annotations

import signal
import time

import pytest

from tests.support.loop_harness import Processes, until
from tests.support.operator_harness import operator
from tests.support.small_loop import (
    LIMIT,
    PARAMETERS,
    adapted,
    assert_same_training,
    in_process,
    start_pair,
    start_tuner,
)

pytestmark = pytest.mark.topics

VALUES = {
    "pde_sim_node": {
        "run",
        "episode",
        "step",
        "horizon",
        "environments",
        "paused",
        "steps/s",
        "episodes",
        "environment steps/s",
        "episodes void",
        "last cost",
        "last diverged",
        "simulated time",
        "states repeated",
        "stale messages",
        "missed deadlines",
        "jitter p99 (us)",
    },
    "controller_node": {
        "run",
        "episode",
        "step",
        "exploring",
        "answers/s",
        "answers",
        "last cost",
        "states that had to wait",
        "models identified",
        "identifications failed",
        "plans that fell back",
        "plant paused",
    },
    "tuner_node": {
        "run",
        "restarts",
        "phase",
        "rollouts",
        "budget",
        "rollouts/s",
        "episode",
        "episodes under way",
        "last cost",
        "adapted cost",
        "cost without control",
        "cost with LQT",
        "episodes repeated",
        "stale messages",
        "paused",
        "paused plants",
        "waiting for",
    },
    "recorder_node": {"run", "bag", "matched", "messages", "messages/s"},
}


def test_every_node_reports_once_a_second_what_an_operator_asks(loop: Processes, tmp_path):
    running = start_pair(loop, real_time_factor=10.0)  # 200 steps a second
    loop.node("recorder_node", "-p", f"bag:={tmp_path / 'bag'}")
    out = tmp_path / "run"
    with operator(loop) as desk:
        running["tuner"] = start_tuner(loop, out, iterations=100_000, recorder="start")
        until(lambda: adapted(out) >= 20, LIMIT, "iteration 20")
        for node in VALUES:
            desk.wait_for_reports(node, 2)
        before = {node: desk.status(node)[0] for node in VALUES}
        began = time.monotonic()
        desk.wait_for_reports("pde_sim_node", 3)
        seconds = time.monotonic() - began
        for node, names in VALUES.items():
            count, level, message, values = desk.status(node)
            assert set(values) == names | {"refused messages", "uptime"}, node
            # Never more often than once a second; how much less is the machine's business.
            assert count - before[node] <= seconds + 2, node
            assert level == 0 or "too late for real time" in message, (node, message)
        plant, tuner = desk.values("pde_sim_node"), desk.values("tuner_node")
        assert plant["run"] == tuner["run"] == desk.values("controller_node")["run"]
        assert float(plant["steps/s"]) > 10
        assert float(plant["environment steps/s"]) > float(plant["steps/s"])
        assert plant["horizon"] == "30"
        assert tuner["phase"] == "adapt"
        assert 0 < float(tuner["cost with LQT"]) < float(tuner["cost without control"])
        assert float(tuner["last cost"]) > 0
        assert desk.values("recorder_node")["matched"] == "yes"
        assert int(desk.values("recorder_node")["messages"]) > 100

        running["controller"].send_signal(signal.SIGKILL)
        silent = "is the controller running?"
        until(lambda: silent in desk.status("pde_sim_node")[2], LIMIT, "warning of the plant")
        assert desk.status("pde_sim_node")[1] == 1
        until(lambda: desk.status("tuner_node")[1] == 1, LIMIT, "warning of the tuner")
        assert desk.status("tuner_node")[2] == "waiting for controller"
        before = desk.status("controller_node")[0]
        running["controller"] = loop.node("controller_node", *PARAMETERS)
        until(lambda: desk.status("tuner_node")[1] == 0, LIMIT, "tuner in order again")

        def answers_again() -> bool:
            count, _, _, values = desk.status("controller_node")
            return count > before and int(values["answers"]) > 0

        until(answers_again, LIMIT, "answers of the new controller")
        running["plant"].send_signal(signal.SIGKILL)
        until(lambda: desk.status("controller_node")[1] == 3, LIMIT, "stale controller")
        assert "no state for" in desk.status("controller_node")[2]
        running["tuner"].send_signal(signal.SIGKILL)
        running["tuner"].wait()
        running["plant"] = loop.node("pde_sim_node", *PARAMETERS)
        running["tuner"] = start_tuner(loop, out, iterations=100_000, resume="true")
        until(lambda: desk.values("tuner_node").get("restarts") == "1", LIMIT, "restart")


def test_refused_messages_are_a_warning_with_their_reason(loop: Processes):
    loop.node("pde_sim_node", *PARAMETERS)
    with operator(loop) as desk:
        desk.wait_for_reports("pde_sim_node", 2)
        assert desk.status("pde_sim_node")[1] == 0
        stranger = loop.start("-c", BAD_START, name="stranger")
        until(
            lambda: desk.status("pde_sim_node")[3].get("refused messages", "0") != "0",
            LIMIT,
            "refusal",
        )
        level, message = desk.status("pde_sim_node")[1:3]
        assert level == 1
        assert "/episode/start: expected rows of 4 numbers" in message
        loop.wait(stranger, LIMIT)
        until(lambda: desk.status("pde_sim_node")[1] == 0, LIMIT, "plant in order again")
        assert int(desk.values("pde_sim_node")["refused messages"]) >= 1


BAD_START = """
import time
import numpy as np, rclpy
from std_msgs.msg import Float64MultiArray
from pdeloop.messages.frames import ArrayCodec, Frame
from pdeloop.ros.endpoints import writer_qos
from pdeloop.messages.topics import START
rclpy.init()
node = rclpy.create_node("stranger")
publisher = node.create_publisher(Float64MultiArray, START.name, writer_qos(START))
while not publisher.get_subscription_count():
    time.sleep(0.05)
for _ in range(30):
    publisher.publish(ArrayCodec(START.labels).encode(Frame(1, 2, 3, 0.5, np.ones((1, 3)))))
    time.sleep(0.1)
"""

LIVE = {
    "/pde_sim_node": {"action_timeout", "max_repeats", "run_hold", "real_time_factor"},
    "/controller_node": set(),
    "/tuner_node": {"max_batch", "episode_timeout", "max_attempts"},
    "/recorder_node": set(),
}
ROS_OWN = {"use_sim_time", "start_type_description_service"}


def test_only_what_no_result_depends_on_may_be_set_and_setting_it_changes_no_result(
    loop: Processes, tmp_path
):
    # A second an episode, so that the training is not over before its parameters were looked at.
    start_pair(loop, real_time_factor=1.5)
    loop.node("recorder_node", "-p", f"bag:={tmp_path / 'bag'}")
    out = tmp_path / "run"
    with operator(loop) as desk:
        tuner = start_tuner(loop, out, iterations=60)
        for node, live in LIVE.items():
            described = desk.ask(describe=node)
            assert {n for n, read_only in described.items() if not read_only} - ROS_OWN == live
            values = desk.ask(get_each=[node, sorted(set(described) - live - ROS_OWN)])
            for name, (accepted, reason) in desk.ask(set_each=[node, values]).items():
                assert not accepted, (node, name)
                assert "read-only" in reason
        plant = "/pde_sim_node"
        accepted, reason = desk.ask(set=[plant, "real_time_factor", -1.0])
        assert not accepted
        assert reason
        accepted, reason = desk.ask(set=["/tuner_node", "episode_timeout", 0.5])
        assert not accepted
        assert reason
        assert desk.ask(set=[plant, "real_time_factor", 5.0])[0]  # 30 steps in 0.3 s
        until(
            lambda: 40 < float(desk.values("pde_sim_node").get("steps/s", 0)) < 130,
            LIMIT,
            "plant at its pace",
        )
        assert desk.ask(set=["/tuner_node", "max_batch", 1])[0]
        until(lambda: desk.values("pde_sim_node")["environments"] == "1", LIMIT, "smaller episodes")
        assert desk.ask(set=[plant, "action_timeout", 0.2])[0]
        assert desk.ask(set=[plant, "max_repeats", 50])[0]
        assert desk.ask(set=[plant, "run_hold", 4.0])[0]
        assert desk.ask(set=["/tuner_node", "episode_timeout", 30.0])[0]
        assert desk.ask(set=["/tuner_node", "max_attempts", 3])[0]
        assert desk.ask(get=["/tuner_node", "max_attempts"]) == 3
        assert desk.ask(set=[plant, "real_time_factor", 0.0])[0]
        loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=60))


SIM_TIME = ("-p", "use_sim_time:=true")


def test_nodes_on_simulated_time_train_the_same_policy(loop: Processes, tmp_path):
    # 75 ms an episode: so long that there are several reports of it.
    plant = loop.node("pde_sim_node", *PARAMETERS, *SIM_TIME, "-p", "real_time_factor:=20.0")
    controller = loop.node("controller_node", *PARAMETERS, *SIM_TIME)
    recorder = loop.node("recorder_node", *SIM_TIME, "-p", f"bag:={tmp_path / 'bag'}")
    clock = loop.start("-c", CLOCK, name="clock")
    out = tmp_path / "run"
    with operator(loop) as desk:
        until(lambda: "ready" in loop.output(clock), LIMIT, "listener")
        tuner = start_tuner(loop, out, iterations=60, recorder="start", use_sim_time="true")
        loop.wait(tuner, LIMIT)
        assert_same_training(out, in_process(iterations=60))
        stamps = [float(x) for x in loop.wait(clock, LIMIT).split()[1:]]
        assert len(set(stamps)) >= 3
        # Stamps of /diagnostics are simulated time of the loop: seconds since it began, and growing.
        assert stamps == sorted(stamps)
        simulated = float(desk.values("pde_sim_node")["simulated time"])
        assert 0 < stamps[-1] <= simulated
    for process in (plant, controller, recorder):
        assert process.poll() is None, loop.output(process)


CLOCK = """
import time
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
rclpy.init()
node = rclpy.create_node("clock", parameter_overrides=[Parameter("use_sim_time", value=True)])
stamps = []
def take(message):
    own = node.get_clock().now().nanoseconds * 1e-9
    stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
    if message.status[0].name == "pde_sim_node: lock-step" and stamp:
        stamps.append(stamp)
        assert own > 0
node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
print("ready", flush=True)
end = time.monotonic() + 200.0
while len(set(stamps)) < 3 and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.2)
print(*stamps)
rclpy.shutdown()
"""


def test_a_second_node_of_the_same_name_is_reported(loop: Processes):
    first = loop.node("controller_node", *PARAMETERS)
    with operator(loop) as desk:
        desk.wait_for_reports("controller_node", 2)
        assert desk.status("controller_node")[1] == 0
        loop.node("controller_node", *PARAMETERS, "-r", "__ns:=/elsewhere")  # not the same name
        second = loop.node("controller_node", *PARAMETERS)
        text = "1 other node(s) called /controller_node in this ROS domain"
        for process in (first, second):
            until(lambda p=process: text in loop.output(p), LIMIT, "warning")
        until(
            lambda: "another node has this name" in desk.status("controller_node")[2],
            LIMIT,
            "warning in the diagnostics",
        )
        assert desk.status("elsewhere/controller_node")[1] == 0
        second.send_signal(signal.SIGINT)
        loop.wait(second, LIMIT)
        until(lambda: desk.status("controller_node")[1] == 0, LIMIT, "one node of that name")


COMPUTES = """
import time
from pdeloop.messages.diagnostics import Status, Level
from pdeloop.ros.node_main import ros_node
fits = 0
def housekeeping(now):
    global fits
    with loop.introspection.working("fitting models"):
        end = time.monotonic() + 2.2
        while time.monotonic() < end:
            sum(range(10_000))
    fits += 1
with ros_node("busy_node", ["--ros-args"]) as (node, loop):
    loop.introspection.report("work", lambda now: Status(Level.OK, "idle", {"fits": fits}))
    loop.run(tick=lambda now: None, deadline=lambda: None, housekeeping=housekeeping)
"""


def test_a_node_that_hardly_does_anything_but_compute_tells_what_and_what_has_changed(loop):
    loop.start("-c", COMPUTES, name="busy")
    with operator(loop) as desk:

        def long_in_a_later_fit() -> bool:
            values = desk.values("busy_node")
            return float(values.get("activity for", 0)) >= 1.0 and int(values.get("fits", 0)) >= 1

        until(long_in_a_later_fit, LIMIT, "report during a fit that counts the ones before")
        _, level, message, values = desk.status("busy_node")
        assert level == 0 and values["activity"] == "fitting models"
        told = int(message.removeprefix("fitting models for ").removesuffix(" s"))
        assert abs(told - float(values["activity for"])) <= 0.5 + 0.05  # each rounded by itself
