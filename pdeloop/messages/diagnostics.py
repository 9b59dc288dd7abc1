# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A node's report on /diagnostics: a level, a sentence, named values. No ROS import.

Levels as in diagnostic_msgs/DiagnosticStatus: OK; WARN, needs attention (a message was
refused, an operator holds the node, a neighbour is missing); ERROR, the node cannot do its work; STALE,
what it shows is old, because nothing comes any more though something should.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass
class Status:
    """One report, as in diagnostic_msgs/DiagnosticStatus; values: by name, in the order of showing."""

    level: Level
    message: str
    values: Mapping[str, object] = field(default_factory=dict)

    def merged(self, level: Level, message: str) -> Status:
        """With another level and message; the worse level counts."""
        if self.level is Level.OK:
            return Status(level, message, self.values)
        return Status(max(self.level, level), f"{self.message}; {message}", self.values)

    def texts(self) -> list[tuple[str, str]]:
        """Names and values as text: numbers with six digits, yes and no, nothing for None."""
        return [(name, _text(value)) for name, value in self.values.items()]


class ConditionTimer:
    """Measures how long a condition has been true, from one check to the next."""

    def __init__(self) -> None:
        self._since: float | None = None

    def seconds(self, holds: bool, now: float) -> float:
        """Seconds since the check that first found it true; 0 where it is not.

        >>> timer = ConditionTimer()
        >>> [timer.seconds(holds, now) for holds, now in ((True, 1.0), (True, 3.5), (False, 4.0))]
        [0.0, 2.5, 0.0]
        """
        if not holds:
            self._since = None
        elif self._since is None:
            self._since = now
        return now - self._since if self._since is not None else 0.0

    @property
    def holds(self) -> bool:
        """True if it was at the last check."""
        return self._since is not None


class Rate:
    """Measures the rate of a counter, from one check to the next."""

    def __init__(self) -> None:
        self._count = 0
        self._when: float | None = None

    def per_second(self, count: int, now: float) -> float:
        """Growth per s since the last call; 0 at the first."""
        since, self._when = self._when, now
        grown, self._count = count - self._count, count
        return grown / (now - since) if since is not None and now > since else 0.0


def _text(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
