# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The layouts for PlotJuggler, Foxglove and RViz: their form, and that they name what there is."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from typing import Any

import yaml

from pdeloop.messages.controllers import CONTROLLERS
from pdeloop.messages.problem import config_folder
from pdeloop.messages.topics import VIEW_NUMBERS
from viewer_node.loop_view import COSTS

VIEWS = config_folder() / "views"
FLOAT, MARKER, IMAGE = (
    "std_msgs/msg/Float64",
    "visualization_msgs/msg/Marker",
    "sensor_msgs/msg/Image",
)
OTHERS = {
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/rosout": "rcl_interfaces/msg/Log",
}


def plotjuggler() -> ET.Element:
    return ET.parse(VIEWS / "plotjuggler.xml").getroot()


def foxglove() -> dict[str, Any]:
    layout: dict[str, Any] = json.loads((VIEWS / "foxglove.json").read_text())
    return layout


def rviz() -> dict[str, Any]:
    config: dict[str, Any] = yaml.safe_load((VIEWS / "pdeloop.rviz").read_text())
    return config


def named_topics() -> dict[str, str]:
    """Every topic of the layouts, with the type that its panel or display shows."""
    found = {}
    for curve in plotjuggler().iter("curve"):
        topic, _, field = curve.attrib["name"].rpartition("/")
        assert field == "data"
        found[topic] = FLOAT
    for name, config in foxglove()["configById"].items():
        match name.split("!")[0]:
            case "Plot":
                for path in config["paths"]:
                    topic, _, field = path["value"].partition(".")
                    assert field == "data"
                    found[topic] = FLOAT
            case "Image":
                found[config["imageMode"]["imageTopic"]] = IMAGE
            case "3D":
                found |= dict.fromkeys(config["topics"], MARKER)
            case "DiagnosticSummary" | "RosOut":
                found[config["topicToRender"]] = OTHERS[config["topicToRender"]]
            case "CallService":
                pass
            case other:
                raise AssertionError(f"unknown panel {other}")
    kinds = {"Marker": MARKER, "Image": IMAGE}
    for display in rviz()["Visualization Manager"]["Displays"]:
        package, kind = display["Class"].split("/")
        assert package == "rviz_default_plugins"
        if kind in kinds:
            found[display["Topic"]["Value"]] = kinds[kind]
        else:
            assert kind == "Grid"
    return found


def published() -> dict[str, str]:
    """What viewer_node publishes, by its own table."""
    own = {f"/view/{name}": FLOAT for name in VIEW_NUMBERS}
    return own | {"/view/field": MARKER, "/view/target": MARKER, "/view/spacetime": IMAGE} | OTHERS


def test_every_topic_of_the_layouts_is_published_with_that_type():
    named = named_topics()
    assert len(named) > 10
    assert named.items() <= published().items()


def test_every_number_is_plotted_and_subscribed_to():
    root = plotjuggler()
    curves = {curve.attrib["name"] for curve in root.iter("curve")}
    assert curves == {f"/view/{name}/data" for name in VIEW_NUMBERS}
    assert {topic.attrib["name"] for topic in root.iter("topic")} == {
        f"/view/{name}" for name in VIEW_NUMBERS
    }


def test_the_costs_have_the_names_and_colours_of_their_controllers():
    curves = {curve.attrib["name"]: curve.attrib["color"] for curve in plotjuggler().iter("curve")}
    configs = foxglove()["configById"]
    paths = {p["value"]: p for c in configs.values() if "paths" in c for p in c["paths"]}
    for key, number in COSTS.items():
        name, colour, _ = CONTROLLERS[key]
        assert curves[f"/view/{number}/data"] == colour
        path = paths[f"/view/{number}.data"]
        assert (path["label"], path["color"]) == (name, colour)


def test_the_foxglove_layout_calls_services_that_there_are():
    policy = ET.parse(config_folder() / "sros2_policy.xml")
    services = {
        service.text.replace("~", f"/{profile.attrib['node']}")
        for profile in policy.iter("profile")
        for service in profile.iter("service")
        if service.text
    }
    panels = foxglove()["configById"].items()
    called = {panel["serviceName"] for name, panel in panels if name.startswith("CallService!")}
    assert called and called <= services


def test_the_rviz_config_has_the_frame_of_the_markers_and_no_display_is_off():
    from viewer_node.node import COLOURS, FRAME_ID

    manager = rviz()["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == FRAME_ID
    markers = [d for d in manager["Displays"] if d["Class"].endswith("/Marker")]
    assert {name for display in markers for name in display["Namespaces"]} == set(COLOURS)
    assert all(display["Enabled"] for display in manager["Displays"])
    (scene,) = [c for n, c in foxglove()["configById"].items() if n.startswith("3D!")]
    assert scene["followTf"] == FRAME_ID
