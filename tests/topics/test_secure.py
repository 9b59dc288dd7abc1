"""The SROS2 policy names exactly what the running nodes do."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import pytest

from pdeloop.secure import EVERY_NODE_ANSWERS, EVERY_NODE_PUBLISHES, ROLES, policy
from tests.loop_harness import Processes

pytestmark = pytest.mark.topics

GRAPH = """
import json, sys, time
import rclpy
rclpy.init()
node = rclpy.create_node("observer")
names = json.loads(sys.argv[1])
seen, before, same, end = {}, None, 0, time.monotonic() + 30.0
while time.monotonic() < end:
    time.sleep(0.5)
    found = {name for name, _ in node.get_node_names_and_namespaces()}
    if not set(names) <= found:
        continue
    seen = {
        name: [
            sorted(topic for topic, _ in query(name, "/"))
            for query in (
                node.get_publisher_names_and_types_by_node,
                node.get_subscriber_names_and_types_by_node,
                node.get_service_names_and_types_by_node,
            )
        ]
        for name in names
    }
    same = same + 1 if seen == before else 0
    if same == 6:  # nothing new for three seconds
        break
    before = seen
print(json.dumps(seen))
"""


def test_the_policy_allows_each_running_node_what_it_does_and_no_more(loop: Processes):
    import json

    for role in ROLES:
        own = {
            "recorder_node": ["-p", "bag:=recorded"],
            "tuner_node": ["-p", "optimizer:=gauss_newton"],
        }.get(role.node, [])
        loop.node(role.node, *own)
    names = [role.node for role in ROLES]
    text = loop.wait(loop.start("-c", GRAPH, json.dumps(names), name="graph"), 40.0)
    seen = json.loads(text.strip().splitlines()[-1])
    for role in ROLES:
        published, subscribed, services = seen[role.node]
        absolute = {name if name.startswith("/") else f"/{name}" for name in role.publishes}
        assert set(published) == absolute | set(EVERY_NODE_PUBLISHES), role.node
        wanted = {name if name.startswith("/") else f"/{name}" for name in role.subscribes}
        assert set(subscribed) - {"/parameter_events"} == wanted, role.node
        answered = {*EVERY_NODE_ANSWERS, *role.services}
        assert set(services) == {f"/{role.node}/{name}" for name in answered}


def test_the_policy_has_the_form_of_sros2_and_an_enclave_for_every_node_of_every_pair():
    root = ET.fromstring(policy("/lab", ("a", "b")))
    assert root.attrib == {"version": "0.2.0"}
    paths = [enclave.attrib["path"] for enclave in root.iter("enclave")]
    assert paths == [
        "/pdeloop/a/pde_sim_node",
        "/pdeloop/b/pde_sim_node",
        "/pdeloop/a/controller_node",
        "/pdeloop/b/controller_node",
        "/pdeloop/tuner_node",
        "/pdeloop/recorder_node",
        "/pdeloop/a/viewer_node",
        "/pdeloop/b/viewer_node",
    ]
    plant = next(root.iter("profile"))
    assert plant.attrib == {"ns": "/lab/a", "node": "pde_sim_node"}
    rules = {
        key: [topic.text for topic in topics.iter("topic")]
        for topics in plant.iter("topics")
        for key in topics.attrib
    }
    assert "action" in rules["subscribe"]
    assert "action" not in rules["publish"]
    tuner = next(p for p in root.iter("profile") if p.attrib["node"] == "tuner_node")
    published = [
        topic.text
        for topics in tuner.iter("topics")
        if "publish" in topics.attrib
        for topic in topics.iter("topic")
    ]
    assert {"a/policy", "b/policy"} <= set(published)
