"""The SROS2 policy names exactly what the running nodes do."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Iterable

import pytest

from pdeloop.secure import EVERY_NODE_ANSWERS, EVERY_NODE_PUBLISHES, ROLES, policy
from tests.loop_harness import Processes
from tests.topics.test_loop import LIMIT

pytestmark = pytest.mark.topics

GRAPH = """
import json, sys, time
import rclpy
rclpy.init()
node = rclpy.create_node("observer")
expected, seen, same, end = json.loads(sys.argv[1]), {}, 0, time.monotonic() + 180.0
while same < 6 and time.monotonic() < end:  # as expected, and nothing more for three seconds
    time.sleep(0.5)
    there = {name for name, _ in node.get_node_names_and_namespaces()}
    seen = {
        name: [
            sorted({topic for topic, _ in query(name, "/")} - {"/parameter_events"})
            for query in (
                node.get_publisher_names_and_types_by_node,
                node.get_subscriber_names_and_types_by_node,
                node.get_service_names_and_types_by_node,
            )
        ]
        for name in there.intersection(expected)
    }
    same = same + 1 if seen == expected else 0
print(json.dumps(seen))
"""


def absolute(names: Iterable[str]) -> set[str]:
    return {name if name.startswith("/") else f"/{name}" for name in names}


def test_the_policy_allows_each_running_node_what_it_does_and_no_more(loop: Processes):
    for role in ROLES:
        own = {
            "recorder_node": ["-p", "bag:=recorded"],
            "tuner_node": ["-p", "optimizer:=gauss_newton"],
        }.get(role.node, [])
        loop.node(role.node, *own)
    allowed = {
        role.node: [
            sorted(absolute({*role.publishes, *EVERY_NODE_PUBLISHES}) - {"/parameter_events"}),
            sorted(absolute(role.subscribes)),
            sorted(f"/{role.node}/{name}" for name in {*EVERY_NODE_ANSWERS, *role.services}),
        ]
        for role in ROLES
    }
    text = loop.wait(loop.start("-c", GRAPH, json.dumps(allowed), name="graph"), LIMIT)
    assert json.loads(text.strip().splitlines()[-1]) == allowed


def test_the_policy_has_the_form_of_sros2_and_an_enclave_for_every_node():
    root = ET.fromstring(policy())
    assert root.attrib == {"version": "0.2.0"}
    paths = [enclave.attrib["path"] for enclave in root.iter("enclave")]
    assert paths == [f"/pdeloop/{role.node}" for role in ROLES]
    plant = next(root.iter("profile"))
    assert plant.attrib == {"ns": "/", "node": "pde_sim_node"}
    rules = {
        key: [topic.text for topic in topics.iter("topic")]
        for topics in plant.iter("topics")
        for key in topics.attrib
    }
    assert "action" in rules["subscribe"]
    assert "action" not in rules["publish"]
