"""Reads everything that a viewer publishes, as RViz, Foxglove and PlotJuggler together would.

It says `looking` on stdout once there has been a field, and goes on until it is ended.
"""

from __future__ import annotations

import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.utilities import try_shutdown
from sensor_msgs.msg import Image
from std_msgs.msg import Float64
from visualization_msgs.msg import Marker

from loop_interfaces.isolation import keep_on_this_machine
from loop_interfaces.topics import VIEW_NUMBERS


def main() -> int:
    """Run as `python -m benchmarks.subscriber_load.node`."""
    keep_on_this_machine()
    rclpy.init()
    node = rclpy.create_node("looker")
    seen = False

    def field(message: bytes) -> None:
        nonlocal seen
        if not seen:
            print("looking", flush=True)
        seen = True

    node.create_subscription(Marker, "view/field", field, 1, raw=True)
    node.create_subscription(Marker, "view/target", lambda _: None, 1, raw=True)
    node.create_subscription(Image, "view/spacetime", lambda _: None, 1, raw=True)
    for name in VIEW_NUMBERS:
        node.create_subscription(Float64, f"view/{name}", lambda _: None, 1, raw=True)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
