# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A new law of few readings: a short step on the present model from the law that measured best.

A linear model of the readings is one of the plant near the fields that a law leads it through, and what
it does not foresee changes with the law. So a step is held to the law that it begins with, whose
rollouts are then replayed for the next one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.closed_loop import ClosedLoop
from loop_method.adapt.improve import curvature_of, improve
from loop_method.adapt.settings import ModelBasedSettings

FEWEST = 2
"""Rollouts of a law with which its mean cost counts."""


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


def step(
    loop: ClosedLoop, records: Sequence[Record], law: Array, settings: ModelBasedSettings
) -> tuple[Array, int] | None:
    """The law after a step on replayed rollouts of laws, and how many of L-BFGS that took.

    None where it is not finite on the model.
    """
    fields = loop.beginnings(records)
    weights = np.full(len(fields), 1.0 / len(fields))
    found = improve(
        loop,
        loop.theta(law),
        fields,
        weights,
        curvature_of(loop),
        settings,
        settings.first_gain,
        settings.readings_trust,
    )
    return None if found is None else (loop.policy(found.theta, law), found.steps)
