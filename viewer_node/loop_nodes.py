"""Which nodes are there, how they are, and how fast the loop goes. Pure.

`now` is any monotonic time in s.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

ROLES = {"plant": "state", "controller": "action", "tuner": "episode/start"}
"""Who a node is follows from what it publishes, whatever its name."""
REPORT = 2.5
"""Seconds for which a report of an activity holds: nodes report once a second."""
WINDOW = 3.0
"""Seconds over which rates are taken."""
MOST_VALUES = 32


@dataclass(frozen=True)
class Endpoint:
    """A publisher: its node's full name, and the first bytes of its id, which are its process's."""

    name: str
    process: bytes


@dataclass
class Peer:
    """The node in one role."""

    role: str
    name: str = ""
    present: bool = False
    starts: int = 0
    heard: float | None = None
    known: set[bytes] = field(default_factory=set)
    rivals: int = 0


@dataclass
class Diagnosis:
    """The newest diagnostic_msgs/DiagnosticStatus of a node."""

    when: float
    level: int
    message: str
    values: list[tuple[str, str]]


class Health:
    """What is known of the nodes of one loop."""

    def __init__(self) -> None:
        self.peers = {role: Peer(role) for role in ROLES}
        self._diagnoses: dict[str, Diagnosis] = {}

    def look(self, found: Mapping[str, Iterable[Endpoint]]) -> None:
        """Take who publishes what, by role."""
        for role, peer in self.peers.items():
            endpoints = list(found.get(role, ()))
            processes = {endpoint.process for endpoint in endpoints}
            new = processes - peer.known
            peer.starts += bool(new)
            peer.known |= new
            peer.present = bool(processes)
            peer.rivals = len(processes) - 1 if processes else 0
            for endpoint in endpoints:
                if endpoint.process in (new or processes):
                    peer.name = endpoint.name

    def heard(self, now: float, *roles: str) -> None:
        """A message of these roles came."""
        for role in roles:
            self.peers[role].heard = now

    def diagnosis(
        self, name: str, level: int, message: str, values: Iterable[tuple[str, str]], now: float
    ) -> None:
        """Take a status from /diagnostics; `name` begins with the node's, as is the custom."""
        node = name.split(":")[0].strip().strip("/")
        if node and (node in self._diagnoses or len(self._diagnoses) < 200):
            kept = [(k[:60], v[:120]) for k, v in list(values)[:MOST_VALUES]]
            self._diagnoses[node] = Diagnosis(now, level, message[:200], kept)

    def told(self, now: float) -> list[dict[str, Any]]:
        """What a page is told."""
        rows = []
        for peer in self.peers.values():
            row: dict[str, Any] = {
                "role": peer.role,
                "name": peer.name,
                "present": peer.present,
                "restarts": max(0, peer.starts - 1),
                "rivals": peer.rivals,
                "heard": None if peer.heard is None else round(now - peer.heard, 1),
            }
            known = self._diagnoses.get(peer.name.strip("/"))
            if known is not None and peer.present and now - known.when < 5.0:
                row |= {"level": known.level, "message": known.message, "values": known.values}
            rows.append(row)
        return rows

    def activity(self, now: float) -> dict[str, Any] | None:
        """What a node says that it is computing, and for how many seconds; None if none does."""
        for role in ("tuner", "controller", "plant"):
            known = self._diagnoses.get(self.peers[role].name.strip("/"))
            if known is None or not self.peers[role].present or now - known.when > REPORT:
                continue
            values = dict(known.values)
            if what := values.get("activity"):
                with contextlib.suppress(ValueError):
                    seconds = float(values.get("activity for", 0.0)) + now - known.when
                    return {"role": role, "what": what, "seconds": round(seconds)}
        return None

    def value(self, role: str, key: str, since: float) -> str | None:
        """What the node in `role` said of itself under `key` in /diagnostics, if not before `since`."""
        known = self._diagnoses.get(self.peers[role].name.strip("/"))
        if known is None or known.when < since:
            return None
        return dict(known.values).get(key)


class Rate:
    """A count that grows, and how fast it grew over the last WINDOW."""

    def __init__(self) -> None:
        self._total = 0.0
        self._marks: deque[tuple[float, float]] = deque()

    def add(self, count: float, now: float) -> None:
        """Count `count` more."""
        if not self._marks:
            self._marks.append((now, 0.0))
        self._total += count
        if now - self._marks[-1][0] > 0.02:
            self._marks.append((now, self._total))

    def per_second(self, now: float) -> float:
        """The rate in 1/s."""
        while len(self._marks) > 1 and now - self._marks[0][0] > WINDOW:
            self._marks.popleft()
        if not self._marks:
            return 0.0
        since, before = self._marks[0]
        return (self._total - before) / max(now - since, WINDOW / 10)
