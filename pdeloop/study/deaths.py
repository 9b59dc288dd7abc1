# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Which trainings lose their workers, and which kill them. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

MOST_DEATHS = 20
"""Workers that one training may lose."""
OWN_DEATHS = 3
"""Deaths in a row at the same place by which a training is recognised as their cause."""
CHANCE = 1e-6
"""Largest probability that the deaths of the cause are those of a cluster that loses workers."""
LINES = 5
"""Lines of a training's progress that are shown."""

Row = Mapping[str, Any]
"""Progress of a training: phase, rollouts that are paid, memory_mb, the largest so far."""


@dataclass
class _Lost:
    deaths: int = 0
    in_a_row: int = 0
    furthest: float = -1.0


class Deaths:
    """Counts the workers that trainings lose, each by itself.

    A cluster that takes workers away interrupts a training now here and now there; one that needs too
    much memory dies at the same place each time. So a training is given up after `OWN_DEATHS` deaths
    in a row none of which came further than those before, or where a share p of the attempts of those
    that have ended well were deaths, after n of them with p^n < `CHANCE`; and after `most` in any case.
    """

    def __init__(self, most: int = MOST_DEATHS) -> None:
        self.most = most
        self.total = 0
        self._lost: dict[str, _Lost] = {}
        self._ended = self._innocent = 0

    def of(self, name: str) -> int:
        """The deaths of a training so far."""
        return self._lost[name].deaths if name in self._lost else 0

    def known(self, name: str, deaths: int) -> None:
        """A training has lost so many workers before, to another driver."""
        self._lost[name] = _Lost(deaths)

    def ended(self, name: str) -> None:
        """A training has ended with its worker alive."""
        self._ended += 1
        self._innocent += self.of(name)

    def died(self, name: str, progress: Sequence[Row] = (), *, announced: bool = False) -> str:
        """The worker of a training has died; why to give it up, empty: not yet.

        progress: its last rows; announced: the worker was retired, which is nobody's fault.
        """
        own = self._lost.setdefault(name, _Lost())
        own.deaths += 1
        self.total += 1
        reached = float(progress[-1].get("rollouts", 0.0)) if progress else 0.0
        own.in_a_row = 0 if announced else own.in_a_row + 1 if reached <= own.furthest else 1
        own.furthest = max(own.furthest, reached)
        lines = "; ".join(map(described, progress[-LINES:])) or "it had just begun"
        if own.in_a_row >= self._needed():
            return (
                f"it kills its workers: {own.in_a_row} died in a row at the same place ({lines}); "
                "is there enough memory?"
            )
        if own.deaths >= self.most:
            return f"it has lost {own.deaths} workers, the most of a training ({lines})"
        return ""

    def _needed(self) -> float:
        """Deaths in a row that are hardly chance."""
        share = self._innocent / max(1, self._innocent + self._ended)
        return max(OWN_DEATHS, math.log(CHANCE) / math.log(share)) if share else OWN_DEATHS


def described(row: Row) -> str:
    """One row of progress, in words."""
    return (
        f"{row.get('phase', '?')} after {row.get('rollouts', 0):g} rollouts, "
        f"{row.get('memory_mb', 0):.0f} MB"
    )
