# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Finds out when the nodes of the loop have discovered the recorder, and asks for their parameters."""

from __future__ import annotations

from pdeloop.messages.parameters import table
from pdeloop.messages.spec import FREE
from pdeloop.ros.peers import Peers

PATIENCE = 10.0
"""Seconds in which the graph is expected to show a node's name and its parameter services."""


class Matching:
    """The answers of the loop's nodes: that they have discovered us, and their parameters.

    required: full names of topics that must have a publisher; others: whose publishers, if there
    are any, are also asked.
    """

    def __init__(self, peers: Peers, required: list[str], others: list[str]) -> None:
        self._peers, self._required, self._others = peers, required, others
        self._lacking = True
        self._known: object = None

    def look(self, now: float) -> None:
        """Look at the graph, ask who is new, take answers."""
        found = self._peers.look([*self._others, *self._required], now)
        self._lacking = not all(found[topic] for topic in self._required)
        self._peers.poll()

    def complete(self, now: float) -> bool:
        """True if every required topic has a publisher, and all of them have discovered us.

        A node with parameter services must have answered, however long it takes; one that shows
        none within PATIENCE cannot.
        """
        return not self._lacking and all(
            peer.values is not None or (now - peer.since > PATIENCE and not peer.offers_parameters)
            for peer in self._peers.known
        )

    def changed(self, run: int) -> bool:
        """True if `parameters` may have changed since the last call with the same run."""
        answered = [peer.process for peer in self._peers.known if peer.values]
        changed, self._known = (run, answered) != self._known, (run, answered)
        return changed

    def parameters(self) -> dict[str, object]:
        """The parameters of the nodes that have answered."""
        known = {spec.name for spec in table()}
        return {
            name: value
            for peer in self._peers.known
            for name, value in (peer.values or {}).items()
            if name in known or name.startswith(FREE)
        }
