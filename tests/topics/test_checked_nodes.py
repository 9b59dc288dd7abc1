# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop check` of nodes that others disturb or that do not reach it; what it takes of a topic."""

from __future__ import annotations

import re

import pytest

from tests.support.loop_harness import Processes
from tests.support.small_loop import LIMIT, PARAMETERS

pytestmark = pytest.mark.topics


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("other_plant", "/other_plant, /pde_sim_node"),
        ("pde_sim_node", "/pde_sim_node (2 nodes of this name)"),
    ],
)
def test_two_plants_are_said_to_be_two(loop: Processes, name: str, named: str) -> None:
    loop.node("pde_sim_node", *PARAMETERS)
    other = ("-r", f"__node:={name}", "-p", "physical.viscosity:=0.02")
    loop.node("pde_sim_node", *PARAMETERS, *other)
    check = loop.pdeloop("check", "plant", "--n-a", "4", "--patience", "3")
    said = loop.wait(check, LIMIT, code=1)
    # What was compared before the second one was discovered may be BAD as well.
    assert "BAD  " in said
    assert re.search(rf"several nodes publish /\S+: {re.escape(named)}; stop all but the one", said)


DEAF = """
import rclpy, time
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64MultiArray
from pdeloop.ros.endpoints import writer_qos
from pdeloop.messages.topics import COST, START, STATE, TARGET
rclpy.init()
node = rclpy.create_node("deaf")
for topic in (STATE, COST, TARGET):
    node.create_publisher(Float64MultiArray, topic.name, {offered})
node.create_subscription(Float64MultiArray, "action", print, {asked})
print("ready", flush=True)
rclpy.spin(node)
"""
VOLATILE, LATCHED = "QoSProfile(depth=1)", "writer_qos(TARGET)"


@pytest.mark.parametrize(
    ("offered", "asked", "named"),
    [
        (VOLATILE, VOLATILE, "/deaf publishes /"),
        (
            "writer_qos(topic)",
            LATCHED,
            "/deaf subscribes /action, but its messages cannot arrive (QoS: ",
        ),
    ],
)
def test_a_quality_of_service_that_does_not_fit_is_named(
    loop: Processes, offered: str, asked: str, named: str
) -> None:
    loop.start("-c", DEAF.format(offered=offered, asked=asked), name="deaf")
    check = loop.pdeloop("check", "plant", "--n-a", "4", "--patience", "3")
    said = loop.wait(check, LIMIT, code=1)
    (bad,) = [line for line in said.splitlines() if line.startswith("BAD  topics")]
    assert named in bad and "QoS: " in bad and "docs/protocol.md" in bad


DRAINS = """
import time
from functools import partial
import numpy as np, rclpy
from pdeloop.messages.frames import Frame
from pdeloop.ros.endpoints import Sender
from pdeloop.ros.node_main import ros_node
from pdeloop.messages.topics import ACTION, STATE
from pdeloop.conformance.node import RosTransport
with ros_node("checks", [], partial(RosTransport, (STATE,), "")) as (node, transport):
    sender = Sender(rclpy.create_node("plant"), STATE)
    while sender.publisher.get_subscription_count() < 1:
        time.sleep(0.01)
    for step in range(3):
        sender.send(Frame(1, 2, step, 0.0, np.ones((1, 2))))
    time.sleep(1.0)
    assert transport.next(ACTION, seconds=0.0) is None
    found = [transport.next(STATE, seconds=0.0) for _ in range(4)]
    print([topic_frame and topic_frame[1].step for topic_frame in found])
"""


def test_without_a_wait_the_check_takes_what_has_arrived(loop: Processes) -> None:
    assert loop.wait(loop.start("-c", DRAINS, name="drains"), LIMIT).strip() == "[0, 1, 2, None]"
