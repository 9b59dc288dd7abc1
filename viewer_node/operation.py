# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Requests of operators to a loop's nodes, and the paused ones. Pure.

`now` is any monotonic time in s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from viewer_node.loop_nodes import LoopNodes

VERBS = ("pause", "resume", "step", "stop")
"""std_srvs/Trigger services that nodes of a loop may offer under their private names."""
FAILURE = 15.0
"""Seconds for which the failure of a request is reported."""


@dataclass(frozen=True)
class Call:
    """Call the service NODE/VERB."""

    node: str
    verb: str


@dataclass
class _Request:
    """A request, or its failure, and since when (s)."""

    since: float
    failure: str = ""


class Operation:
    """Requests to the nodes of a loop, and their effect."""

    def __init__(self, nodes: LoopNodes) -> None:
        self._nodes = nodes
        self._requests: dict[Call, _Request] = {}
        self._stopping: tuple[str, int] | None = None
        self.plant_paused = False
        """True if the plant is paused, by its `episode/paused`."""

    def asked(self, call: Call, now: float) -> None:
        """Note that an operator asks a node for something."""
        self._requests[call] = _Request(now)

    def answered(self, call: Call, now: float, failure: str | None) -> None:
        """Note that a node did what it was asked for, or why it did not."""
        if failure is not None:
            self._requests[call] = _Request(now, failure)
            return
        self._requests.pop(call, None)
        if call.verb == "stop":
            self._stopping = call.node, self._nodes.by_role["tuner"].starts

    def requests(self, now: float) -> list[dict[str, Any]]:
        """Requests that are not answered yet, and those that have just failed."""
        for call, request in list(self._requests.items()):
            if request.failure and now - request.since > FAILURE:
                del self._requests[call]
        roles = {node.name: role for role, node in self._nodes.by_role.items() if node.present}
        return [
            {
                "role": roles[call.node],
                "verb": call.verb,
                "seconds": round(now - request.since),
                "failure": request.failure,
            }
            for call, request in self._requests.items()
            if call.node in roles
        ]

    @property
    def stopping(self) -> bool:
        """True while the tuner has agreed to stop and is still there."""
        tuner = self._nodes.by_role["tuner"]
        return tuner.present and self._stopping == (tuner.name, tuner.starts)

    def paused(self, now: float) -> list[str]:
        """The roles of the nodes that say that they are paused.

        One that computes is not: what it says meanwhile may be from before it was resumed.
        """
        activity = self._nodes.activity(now) or {"role": ""}
        said = {
            "plant": self.plant_paused or self._nodes.value("plant", "paused") == "yes",
            "tuner": self._nodes.value("tuner", "paused") == "yes",
        }
        return [
            role
            for role, yes in said.items()
            if yes and self._nodes.by_role[role].present and role != activity["role"]
        ]
