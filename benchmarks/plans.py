# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks plans`: the time of a step of the law `predictive` on each shipped problem.

A field model is fitted to two explorations, and the law plans on it in closed loop, as deviations
from its finite-horizon law.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.families.cases import Case
from benchmarks.field_models import FITTED, Rollouts
from benchmarks.processes import machine
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.problem import shipped_problems
from pdeloop.method.adapt.model_based_predictive import rests
from pdeloop.method.design.lqt import regulator
from pdeloop.method.laws.plans import Planner
from pdeloop.method.models.base import FieldModel

__all__ = ["run", "text"]


def run(
    problems: Sequence[str] = (), *, lengths: Sequence[int] = (20, 80), steps: int = 25
) -> dict[str, Any]:
    """Time steps of plans, each after the first one, by the processor's clock.

    Parameters
    ----------
    problems
        Names of shipped problems; none: all.
    lengths
        Steps H of a plan.
    steps
        Steps that are timed.
    """
    rows = [timed(name, lengths, steps) for name in problems or shipped_problems()]
    return {"machine": machine(), "lengths": list(lengths), "rows": rows}


def timed(name: str, lengths: Sequence[int], steps: int) -> dict[str, Any]:
    """The row of a problem: the kind of its model, and the median time of a step of each H."""
    rollouts = Rollouts(Case("", name))
    explorations = [rollouts.of(seed) for seed in FITTED]
    fitted = rollouts.fit(explorations)
    if fitted is None:
        return {"problem": name, "kind": "none"}
    row: dict[str, Any] = {"problem": name, "kind": fitted.model.kind}
    field = explorations[0].true.states[0]
    for H in lengths:
        row[f"H {H}"] = step_time(planner(fitted.model, rollouts, H, field), field, steps)
    return row


def planner(model: FieldModel, rollouts: Rollouts, H: int, field: Array) -> Planner:
    """Plans of H steps around the law of the model linearised at the target, or of actions."""
    n_z, n_a, (q, r), target = model.n_z, model.n_a, rollouts.weights, rollouts.target
    cost = Cost(
        n_z, n_a, max(rollouts.horizon, 2 * H), state_weight=q, action_weight=r, target=target
    )
    known = regulator(model, cost)
    K, b = (np.zeros((n_a, n_z)), np.zeros(n_a)) if known is None else (known.K, known.b)
    return Planner(
        model,
        cost,
        rollouts.action_set,
        np.ascontiguousarray(K),
        b,
        around=bool(K.any()),
        steps=H,
        terminal=rests(model, cost, field[None]),
    )


def step_time(own: Planner, z: Array, steps: int) -> float:
    """Seconds of a step in closed loop on the model, in the median."""
    z, plan, took = z[None], np.zeros((1, own.steps, len(own.b))), []
    for k in range(1, steps + 2):  # the search from several starts is at step 0
        began = time.process_time()
        a, plan, _ = own.step(plan, z, k)
        took.append(time.process_time() - began)
        plan, z = own.shifted(plan), own.model.step(z, a)
    return float(np.median(took[1:]))


def text(result: Mapping[str, Any]) -> str:
    """A Markdown table."""
    head = ["problem", "model", *(f"ms, H = {H}" for H in result["lengths"])]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for row in result["rows"]:
        times = [
            f"{1e3 * row[f'H {H}']:.2g}" if f"H {H}" in row else "-" for H in result["lengths"]
        ]
        lines.append(f"| {' | '.join([row['problem'], row['kind'], *times])} |")
    return "\n".join(lines)
