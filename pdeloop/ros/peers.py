# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The other nodes of a loop, as the ROS graph shows them, and the parameters that they answer with."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from rclpy.node import Node

from pdeloop.ros.introspection import NAMELESS, full_name, process_of
from pdeloop.ros.parameters import RemoteParameters


@dataclass
class Peer:
    """A process that publishes a topic of the loop.

    process: the first 12 bytes of the ids of its endpoints; since: when it was first seen
    (monotonic s); name: full name of its node, empty until that is discovered; parameters: what it
    was asked for then.
    """

    process: bytes
    since: float
    name: str = ""
    parameters: RemoteParameters | None = None

    @property
    def values(self) -> dict[str, object] | None:
        """Its parameters; None until it has answered."""
        return None if self.parameters is None else self.parameters.values

    @property
    def offers_parameters(self) -> bool:
        """True while the graph shows the node's parameter services."""
        return self.parameters is not None and self.parameters.offered()


class Peers:
    """The processes that publish some topics, each of which is asked for its parameters once."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._known: dict[bytes, Peer] = {}

    @property
    def known(self) -> list[Peer]:
        """Those that were there at the last look."""
        return list(self._known.values())

    def look(self, topics: Iterable[str], now: float) -> dict[str, list[Peer]]:
        """Read the graph: who publishes each of the topics, given by their full names."""
        found = {topic: self._publishers(topic, now) for topic in topics}
        there = {peer.process for peers in found.values() for peer in peers}
        for process in set(self._known) - there:
            gone = self._known.pop(process)
            if gone.parameters is not None:
                gone.parameters.close()
        return found

    def poll(self) -> list[Peer]:
        """Go on with the requests that wait, without waiting; those that have just been answered."""
        answered: list[Peer] = []
        for peer in self._known.values():
            if peer.parameters is not None and peer.values is None:
                peer.parameters.poll()
                if peer.values is not None:
                    answered.append(peer)
        return answered

    def _publishers(self, topic: str, now: float) -> list[Peer]:
        peers = []
        for endpoint in self._node.get_publishers_info_by_topic(topic):
            process = process_of(endpoint)
            peer = self._known.setdefault(process, Peer(process, now))
            if not peer.name and endpoint.node_name != NAMELESS:
                peer.name = full_name(endpoint)
                peer.parameters = RemoteParameters(self._node, peer.name)
            peers.append(peer)
        return peers
