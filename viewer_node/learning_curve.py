# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The learning curve: from a run's progress lines, or from the costs on the topics. Pure."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viewer_node.rollout_costs import Rollouts

SENT = 400
"""Points that a page is sent: more than its pixels would be wasted."""
MAX_POINTS = 4_000
"""Points of one seed that are kept; then every second one goes."""
MAX_SEEDS = 1024
RATE_WINDOW = 60.0
"""Seconds over which the speed is taken that the remaining time is estimated with."""
_VERSIONS = itertools.count(1)


@dataclass
class LearningCurve:
    """Mean stage cost by the rollouts of a seed from its first one on, or by episode.

    axis, phase: what x is, what the training does; budget: the rollouts of a seed, 0 if unknown;
    references: mean stage costs of the closing evaluation, by controller, all on the same fields;
    evaluations: the same of each seed; checked: those of the check, on fields of its own. The points
    are costs on the training's fields, with which none of these compares. diverged: rollouts of the
    adaptation that did; version: differs after each change, and from curve to curve.
    """

    axis: str = "episode"
    phase: str = ""
    budget: int = 0
    references: dict[str, float] = field(default_factory=dict)
    evaluations: dict[int, dict[str, float]] = field(default_factory=dict)
    checked: dict[str, float] = field(default_factory=dict)
    diverged: int = 0
    laws: bool = False
    """Whether a law has been measured, and not only explorations."""
    version: int = field(default_factory=lambda: next(_VERSIONS))
    _points: dict[int, dict[int, tuple[float, float, float]]] = field(default_factory=dict)
    """By seed and x: mean cost, lowest and highest of the rollouts that it is made of."""
    _rollouts: dict[int, int] = field(default_factory=dict)
    _budgets: int = 0
    _checked: dict[int, tuple[float, float]] = field(default_factory=dict)
    _marks: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=2000))

    def row(self, row: Mapping[str, Any]) -> None:
        """Take one line of progress.jsonl; what has another form is left out."""
        self.axis = "rollouts"
        try:
            match row.get("event"):
                case "designed":
                    self._rollouts.setdefault(int(row["seed"]), 0)
                case "phase":
                    self._phase(row)
                case "measured":
                    self._measured(row)
                case "adapted":
                    self._adapted(row)
                case "checked" if row["accepted"]:
                    self._checked[int(row["seed"])] = float(row["none"]), float(row["lqt"])
                    none, lqt = np.mean(list(self._checked.values()), axis=0).tolist()
                    self.checked = {"none": none, "lqt": lqt}
                case "evaluated":
                    names = ("none", "lqt", "adapted")
                    self.evaluations[int(row["seed"])] = {n: float(row[n]) for n in names}
                    done = self.evaluations.values()
                    self.references |= {n: float(np.mean([e[n] for e in done])) for n in names}
        except (KeyError, TypeError, ValueError, OverflowError):
            return
        self.version = next(_VERSIONS)

    def _phase(self, row: Mapping[str, Any]) -> None:
        self.phase = str(row["phase"])[:40]
        paid, budget = ([int(n) for n in row[name]] for name in ("rollouts", "budget"))
        self.budget, self._budgets = max(budget), sum(budget)
        if len(paid) == len(self._rollouts):  # in the order of the seeds
            self._rollouts = dict(zip(self.seeds, paid, strict=True))
            self._marks.append((float(row.get("time", 0.0)), sum(paid)))

    def _measured(self, row: Mapping[str, Any]) -> None:
        seed = int(row["seed"])
        if seed not in self._rollouts and len(self._rollouts) >= MAX_SEEDS:
            return
        self._rollouts.setdefault(seed, 0)
        if "cost" in row:
            self.laws |= row["phase"] == "adapt"
            names = ("cost", "lowest", "highest")
            cost, lowest, highest = (float(row[name]) for name in names)
            self._add(seed, int(row["rollouts"]), (cost, lowest, highest))

    def _adapted(self, row: Mapping[str, Any]) -> None:
        seed, x = int(row["seed"]), int(row["rollouts"])
        if seed not in self._rollouts and len(self._rollouts) >= MAX_SEEDS:
            return
        self._rollouts[seed] = x
        self._marks.append((float(row.get("time", 0.0)), sum(self._rollouts.values())))
        self.diverged += int(row.get("diverged", 0))
        self.laws = True
        if "cost" in row and math.isfinite(cost := float(row["cost"])):
            pair = [float(row[name]) for name in ("cost_plus", "cost_minus") if name in row]
            made_of = [value for value in pair if math.isfinite(value)] or [cost]
            self._add(seed, x, (cost, min(made_of), max(made_of)))

    def episode(self, rollouts: Rollouts) -> None:
        """Take an episode that is over, from the topics alone.

        One with a rollout without control is a comparison, and one of all three controllers gives the
        references. Any other one is a point.
        """
        self.version = next(_VERSIONS)
        self.phase = "identify" if rollouts.explores else "policy"
        if "none" in rollouts.controllers:
            self.phase = "compare"
            if all_three := rollouts.compared("none", "lqt", "adapted"):
                self.references = all_three
            elif only_two := rollouts.compared("none", "lqt"):
                self.checked = only_two
            return
        self.laws |= not rollouts.explores
        self.diverged += 0 if rollouts.explores else int((~rollouts.completed).sum())
        x = 1 + max(self._rollouts.values(), default=0)
        for model in np.unique(rollouts.models).tolist()[:MAX_SEEDS]:
            self._rollouts[model] = x
            own = rollouts.mean[rollouts.completed & (rollouts.models == model)]
            if own.size:
                self._add(model, x, (float(own.mean()), float(own.min()), float(own.max())))

    @property
    def seeds(self) -> list[int]:
        """The seeds that were seen, in order."""
        return sorted(self._rollouts)

    def costs(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Rollouts (X,) and the cost of each seed by then (S, X), NaN before its first.

        A seed keeps its cost until its next point. X is at most SENT.
        """
        xs = np.unique([x for points in self._points.values() for x in points]).astype(np.int64)
        xs = xs[:: -max(1, -(-len(xs) // SENT))][::-1]
        rows = np.full((len(self._points), len(xs)), np.nan)
        for row, (_, points) in zip(rows, sorted(self._points.items()), strict=True):
            own = sorted(points)
            known = np.searchsorted(own, xs, side="right") - 1
            row[known >= 0] = np.array([points[x][0] for x in own])[known[known >= 0]]
        return xs, rows

    def remaining(self, now: float) -> float | None:
        """Estimated seconds to the end of the adaptation at time `now` (epoch s).

        None if it is not known: too little has come, or nothing for longer than the estimate.
        """
        if self.phase != "adapt" or not self.budget or len(self._marks) < 2:
            return None
        last, done = self._marks[-1]
        since, before = next(mark for mark in self._marks if last - mark[0] <= RATE_WINDOW)
        if done <= before or last <= since:
            since, before = self._marks[0]
        if done <= before or last <= since:
            return None
        left = max(0, self._budgets - done) * (last - since) / (done - before)
        waited = max(0.0, now - last)
        return None if 0.0 < left <= waited else max(0.0, left - waited)

    def message(self) -> dict[str, Any]:
        """The message to a page: x, mean, low and high by point, and the cost of every seed."""
        xs, costs = self.costs()
        several = len(costs) > 1
        if several:
            # A seed without a point yet is left out of the mean; there is one with, or no x.
            mean, low, high = (
                f(costs, axis=0).tolist() for f in (np.nanmean, np.nanmin, np.nanmax)
            )
        else:
            points = [own[x] for own in self._points.values() for x in xs.tolist()]
            mean, low, high = ([point[i] for point in points] for i in range(3))
        paid = self._rollouts.values()
        return {
            "axis": self.axis,
            "phase": self.phase,
            "budget": self.budget,
            "band": "seeds" if several else "rollouts",
            "seeds": self.seeds,
            "paid": [min(paid, default=0), max(paid, default=0)],
            "diverged": self.diverged,
            "laws": self.laws,
            "references": self.references,
            "checked": self.checked,
            "evaluations": self.evaluations,
            "x": xs.tolist(),
            "mean": mean,
            "low": low,
            "high": high,
            "costs": [[None if math.isnan(c) else c for c in row] for row in costs.tolist()]
            if several
            else [],
        }

    def _add(self, seed: int, x: int, point: tuple[float, float, float]) -> None:
        points = self._points.setdefault(seed, {})
        points[x] = point  # in place of the same one of a tuner that began again
        if len(points) > MAX_POINTS:
            for old in sorted(points)[1::2]:
                del points[old]
