# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The other nodes of the loop, as the ROS graph shows them.

Whether all have discovered the recorder's subscriptions, and what parameters they have.
"""

from __future__ import annotations

from dataclasses import dataclass

from rclpy.node import Node

from loop_interfaces.parameters import table
from loop_interfaces.ros.introspection import NAMELESS, full_name
from loop_interfaces.ros.parameters import RemoteParameters

PATIENCE = 3.0
"""Seconds in which a node is expected to answer a request for its parameters."""


@dataclass
class _Peer:
    """A process that publishes a topic of the loop, and since when it is known."""

    since: float
    name: str = ""
    parameters: RemoteParameters | None = None

    def matched(self, now: float) -> bool:
        """Whether it has discovered our subscriptions, or has no parameter services to say so."""
        answered = self.parameters is not None and self.parameters.values is not None
        return answered or now - self.since > PATIENCE


class Peers:
    """The nodes of the loop: whether they have discovered our subscriptions, and their parameters.

    required: full names of topics that somebody must publish; others: whose publishers, if there
    are any, are asked, too.
    """

    def __init__(self, node: Node, required: list[str], others: list[str]) -> None:
        self._node, self._required, self._topics = node, required, [*others, *required]
        self._peers: dict[bytes, _Peer] = {}
        self._lacking = list(required)
        self._known: object = None

    def look(self, now: float) -> None:
        """Look at the graph, ask who is new, take answers."""
        seen: set[bytes] = set()
        self._lacking = []
        for topic in self._topics:
            found = self._node.get_publishers_info_by_topic(topic)
            if topic in self._required and not found:
                self._lacking.append(topic)
            for endpoint in found:
                # The first 12 bytes of an endpoint's id are its process's.
                process = bytes(endpoint.endpoint_gid)[:12]
                seen.add(process)
                peer = self._peers.setdefault(process, _Peer(now))
                if not peer.name and endpoint.node_name != NAMELESS:
                    peer.name = full_name(endpoint)
                    peer.parameters = RemoteParameters(self._node, peer.name)
        for process in set(self._peers) - seen:
            self._drop(process)
        for peer in self._peers.values():
            if peer.parameters is not None:
                peer.parameters.poll()

    def all_matched(self, now: float) -> bool:
        """Whether every required topic has a publisher, and all of them have discovered us."""
        return not self._lacking and all(peer.matched(now) for peer in self._peers.values())

    def changed(self, run: int) -> bool:
        """Whether `parameters` may have changed since the last call with the same run."""
        answered = [
            p for p, peer in self._peers.items() if peer.parameters and peer.parameters.values
        ]
        changed, self._known = (run, answered) != self._known, (run, answered)
        return changed

    def parameters(self) -> dict[str, object]:
        """The loop's parameters, as far as its nodes have answered."""
        known = {spec.name for spec in table()}
        answers = [peer.parameters.values for peer in self._peers.values() if peer.parameters]
        return {
            name: value
            for values in answers
            for name, value in (values or {}).items()
            if name in known or name.startswith("physical.")
        }

    def _drop(self, process: bytes) -> None:
        peer = self._peers.pop(process)
        if peer.parameters is not None:
            peer.parameters.close()
