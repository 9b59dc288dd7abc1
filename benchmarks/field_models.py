# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks field_models`: which model of the whole field is selected, and its error.

On every case of `benchmarks.families` models are fitted to one and to two explorations, and to these
with two rollouts of a law, that of the second model linearised at the target. They are judged on
rollouts that nothing was fitted to: of noisy plants by the fields themselves.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import pdeloop
from benchmarks.families import plants
from benchmarks.families.cases import CASES, Case
from pdeloop.messages.action_set import ANY_ACTION
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.design.lqt import regulator
from pdeloop.method.models import FittedModel, Measured, Selection, affine_law
from pdeloop.method.models.base import Law, errors, saturated

__all__ = ["run", "text"]

FITTED = (1, 2)
"""Seeds of the explorations."""
UNDER_LAW = (21, 22)
"""Seeds of the rollouts of the law that are fitted."""
HELD_OUT = (31, 32, 33)
WORST = 2.0
"""E of a model that diverges."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """A rollout as it was measured, the same as it was, and its mean stage cost."""

    measured: Measured
    true: Measured
    cost: float


class Rollouts:
    """Rollouts of a case."""

    def __init__(self, case: Case) -> None:
        self._own: Any = getattr(plants, case.plant)() if case.plant else None
        if self._own is not None:
            plant: Any = self._own
            self.variance = case.settings["exploration_variance"]
            self.action_set, self.noise = ANY_ACTION, 0.0
        else:
            problem = pdeloop.problem(case.base, **case.parameters())
            plant = self._plant = problem.plant()
            self.action_set = plant.action_set
            given = problem.values["exploration_variance"]
            self.variance = given or self.action_set.exploration_variance
            self.noise = plant.instruments.measurement_noise
        self.n_a, self.horizon = plant.n_a, plant.horizon
        self.weights = plant.state_weight, plant.action_weight
        self.target: Array = plant.target

    def of(self, seed: int, law: Law | None = None) -> Rollout:
        """The rollout of a seed, under a law or white inputs."""
        rng = np.random.default_rng([seed, 1])
        size = self.horizon, 1, self.n_a
        white = rng.standard_normal(size) * np.sqrt(self.variance)
        acts = law or (lambda k, z: white[k])
        if self._own is not None:
            return self._alone(rng, law, acts)
        noise = np.array([seed]) if self.noise else None
        episode = pdeloop.rollout(self._plant, acts, [seed], noise)
        steps = int(episode.costs.diverged_step[0])
        steps = self.horizon if steps < 0 else steps
        actions = episode.actions[:steps, 0]
        states, fields = (z[: steps + 1, 0] for z in (episode.states, episode.fields))
        cost = float(episode.costs.mean[0])
        return Rollout(Measured(states, actions, law), Measured(fields, actions, law), cost)

    def _alone(self, rng: np.random.Generator, law: Law | None, acts: Law) -> Rollout:
        z = self._own.initial_state(rng)[None]
        states, actions = [z[0]], []
        for k in range(self.horizon):
            a = acts(k, z)
            with np.errstate(all="ignore"):
                z = self._own.step(z, a)
            if not np.abs(z).max() < 1e3:
                break
            states.append(z[0])
            actions.append(a[0])
        measured = Measured(np.array(states), np.array(actions), law)
        q, r = self.weights
        cost = q * np.sum((measured.states[:-1] - self.target) ** 2) + r * np.sum(
            measured.actions**2
        )
        whole = len(actions) == self.horizon
        return Rollout(measured, measured, float(cost) / self.horizon if whole else np.inf)

    def fit(self, rollouts: Sequence[Rollout]) -> FittedModel | None:
        """The model of measured rollouts."""
        how = Selection(
            target=self.target,
            noise=self.noise,
            action_set=self.action_set,
        )
        return how.fit([rollout.measured for rollout in rollouts])

    def law(self, fitted: FittedModel) -> Law | None:
        """The law of a model linearised at the target."""
        weights = dict(zip(("state_weight", "action_weight"), self.weights, strict=True))
        cost = Cost(len(self.target), self.n_a, self.horizon, **weights, target=self.target)
        known = regulator(fitted.model, cost)
        return None if known is None else saturated(affine_law(known.K, known.b), self.action_set)


def run(cases: Sequence[str] = ()) -> dict[str, Any]:
    """Fit models of the whole field, and report the selected one and its error.

    Parameters
    ----------
    cases
        Names of cases, or beginnings of names; none: all cases.
    """
    chosen = [name for name in CASES if not cases or name.startswith(tuple(cases))]
    if not chosen:
        raise ValueError(f"no case begins with {' or '.join(cases)}; known: {', '.join(CASES)}")
    return {"rows": [row for name in chosen for row in study(name)]}


def study(name: str) -> list[dict[str, Any]]:
    """The rows of a case."""
    rollouts = Rollouts(CASES[name])
    explorations = [rollouts.of(seed) for seed in FITTED]
    held_out = [rollouts.of(seed) for seed in HELD_OUT]
    rows = [
        judged(name, what, rollouts, data, held_out)
        for what, data in (("1 exploration", explorations[:1]), ("2 explorations", explorations))
    ]
    law = rollouts.law(rows[-1]["fitted"]) if rows[-1]["fitted"] else None
    if law is not None:
        under = [rollouts.of(seed, law) for seed in UNDER_LAW]
        of_law = [rollouts.of(seed, law) for seed in HELD_OUT]
        if all(np.isfinite(rollout.cost) and rollout.cost < 1e9 for rollout in [*under, *of_law]):
            what = "and 2 rollouts of its law"
            rows.append(judged(name, what, rollouts, explorations + under, held_out, of_law))
    return [{key: value for key, value in row.items() if key != "fitted"} for row in rows]


def judged(
    name: str,
    what: str,
    rollouts: Rollouts,
    data: Sequence[Rollout],
    held_out: Sequence[Rollout],
    of_law: Sequence[Rollout] = (),
) -> dict[str, Any]:
    """A fit and its errors."""
    began = time.process_time()
    fitted = rollouts.fit(data)
    seconds = time.process_time() - began
    row: dict[str, Any] = {"case": name, "fitted to": what, "fitted": fitted, "seconds": seconds}
    if fitted is None:
        return row
    row |= {"kind": fitted.model.kind, "error": fitted.error, "candidates": fitted.candidates}
    for key, others in (("explorations", held_out), ("law", of_law)):
        if others:
            true = [rollout.true for rollout in others]
            row[key] = float(errors(fitted.model, true, rollouts.target, WORST).mean())
    return row


def text(result: Mapping[str, Any]) -> str:
    """A Markdown table."""
    head = ["case", "fitted to", "kind", "E", "E of other explorations", "E of its law", "seconds"]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    last = ""
    for row in result["rows"]:
        numbers = [
            f"{row[key]:.0e}" if key in row else "" for key in ("error", "explorations", "law")
        ]
        name = "" if row["case"] == last else row["case"]
        cells = [name, row["fitted to"], row.get("kind", "none"), *numbers, f"{row['seconds']:.1f}"]
        lines.append(f"| {' | '.join(cells)} |")
        last = row["case"]
    return "\n".join(lines)
