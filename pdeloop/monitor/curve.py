"""The training curve: from a run's progress lines, or from the costs on the topics. Pure."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from loop_interfaces.frames import Frame
from loop_interfaces.topics import COMPLETED, VOID, CostColumn, StartColumn

MOST = 20_000
"""Points that are kept; older ones go."""
POINTS = 1_000
"""Points that a page is told: more than its pixels would be wasted."""


@dataclass
class Point:
    """Costs of one iteration: by seed, and of all its rollouts."""

    seeds: dict[int, float] = field(default_factory=dict)
    rollouts: list[float] = field(default_factory=list)
    diverged: int = 0

    def told(self, x: int) -> list[float | int | None]:
        """[x, mean, low, high, diverged]: the band is over seeds, of a single one over rollouts."""
        costs = list(self.seeds.values())
        if not costs:
            return [x, None, None, None, self.diverged]
        spread = costs if len(costs) > 1 else (self.rollouts or costs)
        return [x, float(np.mean(costs)), min(spread), max(spread), self.diverged]


@dataclass
class Curve:
    """Cost by iteration.

    axis: what its x is; phase: what the training does; references: mean stage costs to compare
    with, by controller; total: iterations asked for, 0 if unknown; version grows with each change.
    """

    axis: str = "episode"
    phase: str = ""
    total: int = 0
    seeds: set[int] = field(default_factory=set)
    references: dict[str, float] = field(default_factory=dict)
    points: dict[int, Point] = field(default_factory=dict)
    version: int = 0
    number: int = field(default_factory=itertools.count().__next__)
    """Tells one curve from another."""
    _checked: dict[int, tuple[float, float]] = field(default_factory=dict)
    _evaluated: dict[int, dict[str, float]] = field(default_factory=dict)

    def row(self, row: Mapping[str, Any]) -> None:
        """Take one line of progress.jsonl; what has another form is left out."""
        self.axis = "iteration"
        event = row.get("event")
        try:
            if event == "phase":
                self.phase = str(row["phase"])[:40]
            elif event == "iteration":
                self._iteration(row)
            elif event == "checked" and row["accepted"]:
                self._checked[int(row["seed"])] = float(row["none"]), float(row["lqt"])
                none, lqt = np.mean(list(self._checked.values()), axis=0).tolist()
                self.references |= {"none": none, "lqt": lqt}
            elif event == "evaluated":
                names = ("none", "lqt", "adapted")
                self._evaluated[int(row["seed"])] = {n: float(row[n]) for n in names}
                done = self._evaluated.values()
                self.references |= {n: float(np.mean([e[n] for e in done])) for n in names}
        except (KeyError, TypeError, ValueError, OverflowError):
            return
        self.version += 1

    def _iteration(self, row: Mapping[str, Any]) -> None:
        seed = int(row["seed"])
        self.seeds.add(seed)
        point = self._point(int(row["iteration"]))
        point.diverged += int(row.get("diverged", 0))
        if "cost" in row and math.isfinite(float(row["cost"])):
            point.seeds[seed] = float(row["cost"])
            pair = [float(row[name]) for name in ("cost_plus", "cost_minus") if name in row]
            point.rollouts += [cost for cost in pair if math.isfinite(cost)]

    def rollouts(self, start: Frame, policy: Frame | None, cost: Frame) -> None:
        """Take an episode that is over, from the topics alone.

        An episode in which a row has no control is a comparison: it gives that reference. Any other
        one with a policy is a point.
        """
        explores = bool((start.values[:, StartColumn.EXCITATION] >= 0).any())
        ended = cost.values[:, CostColumn.ENDED]
        if len(start.values) != len(cost.values) or (ended == VOID).any():
            return
        self.version += 1
        self.phase = "identify" if explores else "policy"
        if explores:
            return
        good, mean = ended == COMPLETED, cost.values[:, CostColumn.MEAN]
        if policy is not None and len(policy.values) == len(mean):
            none = ~policy.values.any(axis=(1, 2))
            if none.any():
                self.phase = "compare"
                if (none & good).any():
                    self.references["none"] = float(mean[none & good].mean())
                return
        point = self._point(1 + max(self.points, default=0))
        point.diverged = int((~good).sum())
        point.rollouts = mean[good].tolist()
        models = start.values[:, StartColumn.MODEL]
        for model in np.unique(models):
            own = good & (models == model)
            self.seeds.add(int(model))
            if own.any():
                point.seeds[int(model)] = float(mean[own].mean())

    def told(self) -> dict[str, Any]:
        """What a page is told."""
        every = max(1, -(-len(self.points) // POINTS))
        return {
            "axis": self.axis,
            "phase": self.phase,
            "total": self.total,
            "band": "seeds" if len(self.seeds) > 1 else "rollouts",
            "seeds": len(self.seeds),
            "references": self.references,
            "points": [point.told(x) for x, point in list(self.points.items())[::-every][::-1]],
        }

    def _point(self, x: int) -> Point:
        if x not in self.points and len(self.points) >= MOST:
            del self.points[next(iter(self.points))]
        return self.points.setdefault(x, Point())
