"""`pdeloop secure`: a policy for SROS2 in which each node has its own topics and nothing else.

The form is the policy schema 0.2.0 of SROS2 (`ros2 security generate_artifacts -p FILE`). It needs a
ROS 2 whose middleware is built with DDS security; the PyPI wheels' is not (docs/security.md).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

from loop_interfaces import topics


@dataclass(frozen=True)
class Role:
    """The topics of one node, by relative name (absolute ones begin with /), and its own services."""

    node: str
    publishes: tuple[str, ...]
    subscribes: tuple[str, ...]
    services: tuple[str, ...] = ()
    of_others: tuple[str, ...] = ()
    """What it subscribes only sometimes: where the plant is another one, that publishes no `samples`,
    and where views are recorded.
    """


_ARRAYS = tuple(topic.name for topic in topics.ARRAYS)
_SAMPLED = (topics.STATE.name, topics.ACTION.name)
ROLES = (
    Role(
        "pde_sim_node",
        (
            *(topics.STATE.name, topics.COST.name, topics.TARGET.name, topics.PAUSED.name),
            *(topics.SAMPLES, topics.SAMPLES_THROTTLED, "/clock"),
        ),
        (topics.START.name, topics.ACTION.name),
        ("pause", "resume", "step"),
    ),
    Role(
        "controller_node",
        (topics.ACTION.name, topics.MODEL_IDENTIFIED.name, topics.MODEL_FAILED),
        tuple(
            topic.name
            for topic in (
                *(topics.STATE, topics.TARGET, topics.START),
                *(topics.POLICY, topics.MODEL, topics.COST, topics.PAUSED),
            )
        ),
    ),
    Role(
        "tuner_node",
        (topics.POLICY.name, topics.START.name, topics.MODEL.name),
        (
            *(topics.COST.name, topics.MODEL_IDENTIFIED.name, topics.MODEL_FAILED),
            topics.PAUSED.name,
            *(topics.SAMPLES, topics.TARGET.name),  # for Gauss-Newton
        ),
        ("pause", "resume", "stop"),
        _SAMPLED,
    ),
    Role(
        "recorder_node",
        (topics.RECORDER_STATUS,),
        (
            *(n for n in _ARRAYS if n not in _SAMPLED),
            *(topics.SAMPLES, topics.MODEL_FAILED, "/diagnostics", "/rosout"),
        ),
        of_others=(*_SAMPLED, "/clock", *topics.VIEWS),
    ),
    Role(
        "viewer_node",
        tuple(topics.VIEWS),
        (
            *(topics.START.name, topics.POLICY.name, topics.MODEL.name, topics.COST.name),
            *(topics.TARGET.name, topics.PAUSED.name, topics.SAMPLES_THROTTLED),
        ),
        of_others=_SAMPLED,
    ),
)
"""Who may publish and subscribe what; the tests hold it against the running nodes."""

EVERY_NODE_PUBLISHES = ("/rosout", "/parameter_events", "/diagnostics")
EVERY_NODE_ANSWERS = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "get_type_description",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
)


def policy() -> str:
    """The SROS2 policy of a loop, as XML. The enclave of a node is /pdeloop/NODE."""
    root = ET.Element("policy", version="0.2.0")
    enclaves = ET.SubElement(root, "enclaves")
    for role in ROLES:
        enclave = ET.SubElement(enclaves, "enclave", path=f"/pdeloop/{role.node}")
        profiles = ET.SubElement(enclave, "profiles")
        profile = ET.SubElement(profiles, "profile", ns="/", node=role.node)
        services = ET.SubElement(profile, "services", reply="ALLOW")
        for service in (*EVERY_NODE_ANSWERS, *role.services):
            ET.SubElement(services, "service").text = f"~/{service}"
        for verb, names in (
            ("publish", (*EVERY_NODE_PUBLISHES, *role.publishes)),
            ("subscribe", (*role.subscribes, *role.of_others)),
        ):
            rules = ET.SubElement(profile, "topics", {verb: "ALLOW"})
            for name in names:
                ET.SubElement(rules, "topic").text = name
    ET.indent(root)
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    return head + ET.tostring(root, encoding="unicode") + "\n"
