# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reads all that a viewer publishes, or all that the live page at an address is told.

    python -m benchmarks.reader [http://127.0.0.1:8080/]

It says `reading` once there has been a field or an episode, and continues until it is ended.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import sys

import aiohttp
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.utilities import try_shutdown
from sensor_msgs.msg import Image
from std_msgs.msg import Float64
from visualization_msgs.msg import Marker

from pdeloop.messages.topics import VIEW_NUMBERS
from pdeloop.process.isolation import keep_on_this_machine


@functools.cache
def tell() -> None:
    """Say, once, that something came."""
    print("reading", flush=True)


def read_views() -> None:
    """Read as RViz, Foxglove and PlotJuggler together would."""
    keep_on_this_machine()
    rclpy.init()
    node = rclpy.create_node("reader")
    node.create_subscription(Marker, "view/field", lambda _: tell(), 1, raw=True)
    node.create_subscription(Marker, "view/target", lambda _: None, 1, raw=True)
    node.create_subscription(Image, "view/spacetime", lambda _: None, 1, raw=True)
    for name in VIEW_NUMBERS:
        node.create_subscription(Float64, f"view/{name}", lambda _: None, 1, raw=True)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    try_shutdown()


async def read_page(address: str) -> None:
    """Read as a browser would, as fast as data arrive."""
    origin = {"Origin": address.rstrip("/")}
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{address}ws", headers=origin, max_msg_size=0) as page,
    ):
        async for message in page:
            if message.type is aiohttp.WSMsgType.BINARY:
                tell()


if __name__ == "__main__":
    if len(sys.argv) > 1:
        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(read_page(sys.argv[1]))
    else:
        read_views()
