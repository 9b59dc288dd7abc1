"""What operators ask of a loop's nodes, and who is paused. Pure.

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
OVERRULED = 5.0
"""Seconds after which a paused plant that goes on was resumed by somebody else."""


@dataclass(frozen=True)
class Call:
    """Call the service NODE/VERB."""

    node: str
    verb: str


@dataclass
class _Request:
    """Since when something was asked for; why and when it failed."""

    since: float
    failure: str = ""
    failed: float | None = None


class Operation:
    """Requests to the nodes of a loop, and their effect."""

    def __init__(self, nodes: LoopNodes) -> None:
        self._nodes = nodes
        self._requests: dict[Call, _Request] = {}
        self._answered: dict[str, float] = {}
        self._paused: dict[str, float] = {}
        self._stopping: tuple[str, int] | None = None
        self.plant_paused = False
        """What the plant says on `episode/paused`."""

    def asked(self, call: Call, now: float) -> None:
        """Somebody asks a node for something."""
        self._requests[call] = _Request(now)

    def answered(self, call: Call, now: float, failure: str | None) -> None:
        """A node did what it was asked to, or not: then why."""
        if failure is not None:
            self._requests[call] = _Request(now, failure, now)
            return
        self._requests.pop(call, None)
        self._answered[call.node] = now
        if call.verb == "pause":
            self._paused[call.node] = now
        elif call.verb in ("resume", "stop"):
            self._paused.pop(call.node, None)
        if call.verb == "stop":
            self._stopping = call.node, self._nodes.by_role["tuner"].starts

    def plant_stepped(self, now: float) -> None:
        """The plant goes on."""
        plant = self._nodes.by_role["plant"].name
        if now - self._paused.get(plant, now) > OVERRULED:
            del self._paused[plant]

    def requests(self, now: float) -> list[dict[str, Any]]:
        """What was asked for and is not answered yet, and what has just failed."""
        for call, request in list(self._requests.items()):
            if request.failed is not None and now - request.failed > FAILURE:
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
        """Whether the tuner has agreed to stop, and is still there."""
        tuner = self._nodes.by_role["tuner"]
        return tuner.present and self._stopping == (tuner.name, tuner.starts)

    def paused(self) -> list[str]:
        """The roles of the nodes that are paused."""
        found = []
        for role in ("plant", "tuner"):
            node = self._nodes.by_role[role]
            reported = self._nodes.value(role, "paused", since=self._answered.get(node.name, 0.0))
            published = self.plant_paused and role == "plant"
            if node.present and (published or node.name in self._paused or reported == "yes"):
                found.append(role)
        return found
