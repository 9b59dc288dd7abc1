# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The nodes of a loop that are present, their reports, and requests of operators to them. Pure.

`now` is any monotonic time in s.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

ROLES = {"plant": "state", "controller": "action", "tuner": "episode/start"}
"""Topics by which a node's role is recognised, whatever its name."""
REPORTED = 2.5
"""Seconds for which a report of an activity holds: nodes report once a second."""
MAX_VALUES = 32


@dataclass(frozen=True)
class Endpoint:
    """A publisher: its node's full name, and the first bytes of its id, which are its process's."""

    name: str
    process: bytes


@dataclass
class RoleState:
    """The node in one role."""

    role: str
    name: str = ""
    present: bool = False
    starts: int = 0
    heard: float | None = None
    known: set[bytes] = field(default_factory=set)
    rivals: int = 0


@dataclass
class NodeReport:
    """The newest diagnostic_msgs/DiagnosticStatus of a node."""

    when: float
    level: int
    message: str
    values: list[tuple[str, str]]


class LoopNodes:
    """The known nodes of one loop."""

    def __init__(self) -> None:
        self.by_role = {role: RoleState(role) for role in ROLES}
        self._reports: dict[str, NodeReport] = {}

    def update(self, found: Mapping[str, Iterable[Endpoint]]) -> None:
        """Take who publishes what, by role."""
        for role, node in self.by_role.items():
            endpoints = list(found.get(role, ()))
            processes = {endpoint.process for endpoint in endpoints}
            new = processes - node.known
            node.starts += bool(new)
            node.known |= new
            node.present = bool(processes)
            node.rivals = len(processes) - 1 if processes else 0
            for endpoint in endpoints:
                if endpoint.process in (new or processes):
                    node.name = endpoint.name

    def heard(self, now: float, *roles: str) -> None:
        """A message of these roles came."""
        for role in roles:
            self.by_role[role].heard = now

    def diagnosis(
        self, name: str, level: int, message: str, values: Iterable[tuple[str, str]], now: float
    ) -> None:
        """Take a status from /diagnostics; `name` begins with the node's, as is the custom."""
        node = name.split(":")[0].strip().strip("/")
        if node and (node in self._reports or len(self._reports) < 200):
            kept = [(k[:60], v[:120]) for k, v in list(values)[:MAX_VALUES]]
            self._reports[node] = NodeReport(now, level, message[:200], kept)

    def message(self, now: float) -> list[dict[str, Any]]:
        """The message to a page."""
        rows = []
        for node in self.by_role.values():
            row: dict[str, Any] = {
                "role": node.role,
                "name": node.name,
                "present": node.present,
                "restarts": max(0, node.starts - 1),
                "rivals": node.rivals,
                "heard": None if node.heard is None else round(now - node.heard, 1),
            }
            known = self._reports.get(node.name.strip("/"))
            if known is not None and node.present and now - known.when < 5.0:
                row |= {"level": known.level, "message": known.message, "values": known.values}
            rows.append(row)
        return rows

    def activity(self, now: float) -> dict[str, Any] | None:
        """The computation that a node reports, and its seconds so far; None if there is none."""
        for role in ("tuner", "controller", "plant"):
            known = self._reports.get(self.by_role[role].name.strip("/"))
            if known is None or not self.by_role[role].present or now - known.when > REPORTED:
                continue
            values = dict(known.values)
            if what := values.get("activity"):
                with contextlib.suppress(ValueError):
                    seconds = float(values.get("activity for", 0.0)) + now - known.when
                    return {"role": role, "what": what, "seconds": round(seconds)}
        return None

    def value(self, role: str, key: str) -> str | None:
        """The value of `key` in the newest /diagnostics of the node in `role`."""
        report = self._reports.get(self.by_role[role].name.strip("/"))
        return None if report is None else dict(report.values).get(key)


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
