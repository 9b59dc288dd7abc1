# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Steps along measured rollouts, with which a law is improved where no model predicts them.

With the innovations e_k = z_{k+1} - f(z_k, a_k) of a measured rollout a model f repeats it exactly,

    z_{k+1} = f(z_k, a_k) + e_k        (`ClosedLoop.replays_of`),

so that the cost of the law that it was measured under is the measured one, and the model says only how
it changes with the law. That holds near this law: a step is held to it by a trust region, and rollouts
on the same initial fields, of which the differences vary far less than the costs themselves, decide
whether it is taken. The trust region grows where a step was good and shrinks where it was not.

References
----------
Conn, Gould, Toint, "Trust-Region Methods", SIAM 2000, chapter 6.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Record
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.adapt.improve import curvature_of, improve
from pdeloop.method.adapt.settings import FIRST_GAIN, ImprovementSettings

FEWEST = 2
"""Rollouts of a law with which its mean cost counts."""
FIRST_TRUST = 0.3
"""Weight of the distance from the law that a step begins with, relative to the cost's curvature."""
GROWS, SHRINKS, LARGEST_TRUST = 0.5, 4.0, 1e3
"""Factors of this weight after a step that was better and one that was not, and its bound."""


def best_measured(records: Sequence[Record], first: Array) -> Array:
    """The law with the least mean cost among those of at least `FEWEST` rollouts; else the first."""
    costs: dict[bytes, list[float]] = {}
    laws: dict[bytes, Array] = {}
    for record in records:
        laws.setdefault(record.policy.tobytes(), record.policy)
        costs.setdefault(record.policy.tobytes(), []).append(record.cost)
    means = {name: float(np.mean(own)) for name, own in costs.items() if len(own) >= FEWEST}
    if not means or not np.isfinite(min(means.values())):
        return first
    return laws[min(means, key=lambda name: means[name])]


def best_on_same_fields(records: Sequence[Record], laws: Sequence[Array], first: Array) -> Array:
    """The law that costs least relative to the first one on the fields of both.

    A law that diverged where the first one did not is no candidate; where the first one diverged and
    another did not, that one is better.
    """
    base = costs_by_field(records, first)
    best, least = first, 0.0
    for law in laws:
        own = costs_by_field(records, law)
        common = [seed for seed in own if seed in base]
        if len(common) < FEWEST or np.array_equal(law, first):
            continue
        mine, theirs = (np.array([costs[seed] for seed in common]) for costs in (own, base))
        lost, other = np.isinf(mine), np.isinf(theirs)
        if (lost & ~other).any():
            continue
        both = ~lost & ~other
        saved = float(np.mean(theirs[both] - mine[both])) if both.any() else 0.0
        saved = np.inf if (other & ~lost).any() and saved >= 0.0 else saved
        if saved > least:
            best, least = law, saved
    return best


def costs_by_field(records: Sequence[Record], law: Array) -> dict[int, float]:
    """The costs of the rollouts of a law, by the seeds of their initial fields."""
    return {
        record.field_seed: record.cost
        for record in records
        if record.field_seed >= 0 and np.array_equal(record.policy, law)
    }


def step(
    loop: ClosedLoop,
    fields: Array,
    law: Array,
    settings: ImprovementSettings,
    trust: float,
) -> tuple[Array, int] | None:
    """The law after a step on replayed rollouts, and how many of L-BFGS that took.

    None where it is not finite on the model.

    fields: of `ClosedLoop.replays_of`; trust: weight of the distance from the law to begin with.
    """
    weights = np.full(len(fields), 1.0 / len(fields))
    found = improve(
        loop,
        loop.theta(law),
        fields,
        weights,
        curvature_of(loop),
        settings,
        FIRST_GAIN,
        trust,
    )
    return None if found is None else (loop.policy(found.theta, law), found.steps)
