# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The SROS2 policy names exactly what the running nodes do."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET

import pytest

from pdeloop.messages.problem import config_folder
from tests.support.loop_harness import Processes
from tests.support.small_loop import LIMIT

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


POLICY = ET.parse(config_folder() / "sros2_policy.xml").getroot()
WITHOUT_SAMPLES = {"tuner_node", "recorder_node", "viewer_node"}
"""They subscribe to state, action and /clock only where a plant publishes no `samples`."""


def allowed(profile: ET.Element, verb: str) -> list[str]:
    """Full names of the topics that a node may publish or subscribe, as far as it does here."""
    found = profile.findall(f"topics[@{verb}='ALLOW']/topic")
    names = {f"/{(topic.text or '').lstrip('/')}" for topic in found} - {"/parameter_events"}
    if verb == "subscribe" and profile.attrib["node"] in WITHOUT_SAMPLES:
        names -= {"/state", "/action", "/clock"}
    return sorted(names)


def test_the_policy_allows_each_running_node_what_it_does_and_no_more(loop: Processes):
    own = {
        "pde_sim_node": ["-p", "real_time_factor:=10.0"],  # the graph is the same at any speed
        "recorder_node": ["-p", "bag:=recorded"],
        # With more rollouts than there is time for: a tuner that has finished is no part of the graph.
        "tuner_node": ["-p", "optimizer:=model_based", "-p", "rollouts:=100000"],
    }
    expected = {}
    for profile in POLICY.iter("profile"):
        name = profile.attrib["node"]
        loop.node(name, *own.get(name, []))
        services = sorted((s.text or "").replace("~", f"/{name}") for s in profile.iter("service"))
        topics = (allowed(profile, verb) for verb in ("publish", "subscribe"))
        expected[name] = [*topics, services]
    text = loop.wait(loop.start("-c", GRAPH, json.dumps(expected), name="graph"), LIMIT)
    assert json.loads(text.strip().splitlines()[-1]) == expected


def test_the_policy_has_the_form_of_sros2_and_an_enclave_for_every_node():
    assert POLICY.attrib == {"version": "0.2.0"}
    enclaves = {
        enclave.attrib["path"]: next(enclave.iter("profile")).attrib
        for enclave in POLICY.iter("enclave")
    }
    nodes = "pde_sim_node", "controller_node", "tuner_node", "recorder_node", "viewer_node"
    assert enclaves == {f"/pdeloop/{node}": {"ns": "/", "node": node} for node in nodes}
