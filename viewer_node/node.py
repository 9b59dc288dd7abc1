# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""viewer_node: shows a running loop to RViz, Foxglove and PlotJuggler, as a ROS 2 node.

Subscribes  state, action (or samples_throttled), target, episode/start, policy, model, episode/cost
Publishes   view/field, view/target (visualization_msgs/Marker), view/spacetime (sensor_msgs/Image),
            view/... (std_msgs/Float64), at view_rate and only with subscribers
It takes no part in the loop, and nothing waits for it. What is shown: docs/watching.md.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import ColorRGBA, Float64
from visualization_msgs.msg import Marker

from pdeloop.messages.grid import Grid
from pdeloop.messages.parameters import VIEWER, taken_by
from pdeloop.messages.topics import VIEWS
from pdeloop.process.affinity import lower_priority
from pdeloop.process.isolation import keep_on_this_machine
from pdeloop.ros.endpoints import message_class
from pdeloop.ros.node_main import node_main
from pdeloop.ros.observer import Observer
from pdeloop.ros.parameters import declare, given_parameters, on_change
from viewer_node.diagnostics import ViewerDiagnostics
from viewer_node.episode_samples import MAX_COMPONENTS
from viewer_node.loop_reader import PERIOD, LoopReader
from viewer_node.loop_view import LoopView, path_of
from viewer_node.picture import Range, plane, shape_of, space_time

GRAPH_PERIOD = 0.5
"""Period (s) of polling the ROS graph."""
COLOUR_PERIOD = 0.5
"""Seconds between two computations of the range of the colours."""
FRAME_ID = "field"
"""Frame of the markers and the image: x is the place, y the value of the field or, of one on two axes,
the other place; no transform needed."""
LINE_WIDTH = 0.006
"""Width of the lines, as a share of the domain's length."""
COLOURS = {"field": (0.13, 0.40, 0.67), "target": (0.90, 0.45, 0.10)}


class ViewerNode:
    """Reads the loop's topics into the view, and publishes what it shows."""

    def __init__(self, node: Node, loop: Observer) -> None:
        values = declare(node, taken_by("viewer_node"), given_parameters(node, "viewer_node"))
        self._length = float(values["length"])
        told = values["grid"]  # else one periodic axis of the states that come
        self._grid = Grid.parse(told) if told else Grid.interval(self._length, 1)
        weights = float(values["state_weight"]), float(values["action_weight"])
        self._view = LoopView(
            horizon=values["horizon"],
            weights=weights,
            curve_from_topics=False,
            components=[part.name for part in self._grid.parts],
            path=path_of(values),
        )
        if self._grid.lengths:
            self._view.grid = self._grid
        kept = min(len(self._grid.parts), MAX_COMPONENTS)
        self._ranges: list[Range] = [(0.0, 1.0)] * kept
        self._coloured = 0.0
        self._diagnostics = ViewerDiagnostics(self._view)
        self._due = loop.now()
        self._adjust({spec.name: values[spec.name] for spec in VIEWER})
        self.join(node, loop)
        node.get_logger().info(f"{values['problem']}: views at {values['view_rate']:g} Hz")

    def join(self, node: Node, loop: Observer) -> None:
        self._node, self._loop = node, loop
        self._reader = LoopReader(node, "", self._view)
        self._reader.listen(True)
        self._publishers = {
            name.removeprefix("view/"): node.create_publisher(message_class(kind), name, 1)
            for name, kind in VIEWS.items()
        }
        loop.every(PERIOD, self._read)
        loop.every(GRAPH_PERIOD, self._reader.poll_graph)
        loop.introspection.report(
            "views", lambda now: self._diagnostics.report(now, self._subscribers())
        )
        on_change(node, VIEWER, self._adjust)

    def run(self) -> int:
        self._loop.run()
        return 0

    def _read(self) -> None:
        self._reader.read()
        now = self._loop.now()
        if now >= self._due:
            self._due = max(self._due + self._period, now + self._period / 2)
            self._show(now)

    def _adjust(self, values: dict[str, Any]) -> None:
        self._period = 1.0 / values["view_rate"]
        self._view.environment = values["view_environment"]

    def _show(self, now: float) -> None:
        for name, value in self._view.numbers().items():
            self._publishers[name].publish(Float64(data=value))
        profile = self._view.profile()
        if profile is None:
            return
        if now >= self._coloured:
            self._coloured = now + COLOUR_PERIOD
            self._ranges = [
                self._view.colours(i, before, now) for i, before in enumerate(self._ranges)
            ]
        z, target = profile
        for name, values in (("field", z), ("target", target)):
            if values is not None and self._wanted(name):
                self._publishers[name].publish(self._marker(name, values))
        if self._wanted("spacetime"):
            self._publishers["spacetime"].publish(self._picture(self._colours(now, z)))

    def _marker(self, name: str, values: NDArray[np.float64]) -> Marker:
        shape = shape_of(self._grid, values, self._ranges, beside=name == "target")
        marker = Marker(ns=name, id=list(COLOURS).index(name))
        marker.header.frame_id = FRAME_ID
        marker.header.stamp = self._node.get_clock().now().to_msg()
        marker.action = Marker.ADD
        marker.pose.orientation.w = 1.0
        red, green, blue = COLOURS[name]
        marker.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
        marker.points = [Point(x=a, y=b) for a, b in shape.points.tolist()]
        if shape.size is None:
            marker.type = Marker.LINE_LIST if shape.pairs else Marker.LINE_STRIP
            marker.scale.x = LINE_WIDTH * self._length
        else:
            marker.type = Marker.CUBE_LIST
            marker.scale.x, marker.scale.y = shape.size
            marker.scale.z = LINE_WIDTH * self._length
            marker.colors = [ColorRGBA(r=r, g=g, b=b, a=1.0) for r, g, b in shape.colours.tolist()]
        return marker

    def _colours(self, now: float, z: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The picture of a field on two axes or more as it is now, of others over space and time."""
        if len(self._grid.axes) > 1 and z.size == self._grid.size:
            return plane(self._grid, z, self._ranges)
        shown, fields = self._view.shown(now), self._view.space_time(now)
        assert shown is not None and fields is not None  # there is a profile
        parts = [shown.part(i) for i in range(min(shown.components, MAX_COMPONENTS))]
        return space_time(fields, parts, self._ranges[: len(parts)])

    def _picture(self, colours: NDArray[np.uint8]) -> Image:
        height, width, _ = colours.shape
        image = Image(height=height, width=width, encoding="rgb8", step=3 * width)
        image.header.frame_id = FRAME_ID
        image.header.stamp = self._node.get_clock().now().to_msg()
        image.data = colours.tobytes()
        return image

    def _wanted(self, name: str) -> bool:
        return bool(self._publishers[name].get_subscription_count())

    def _subscribers(self) -> int:
        return sum(p.get_subscription_count() for p in self._publishers.values())


def main(args: list[str] | None = None) -> int:
    """Console script."""
    lower_priority(19)
    keep_on_this_machine()
    return node_main("viewer_node", args, ViewerNode, Observer)


if __name__ == "__main__":
    sys.exit(main())
