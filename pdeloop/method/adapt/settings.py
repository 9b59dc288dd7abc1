# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of `model_based`: how a law is improved, and judged."""

from __future__ import annotations

from dataclasses import dataclass

from pdeloop.method.settings import Settings, setting

CONFIRMED = 0.5
"""Share of the gain on its own fields that a law must reach on those left out; otherwise it is made
again on more drawn fields."""
CHAOTIC_FIELDS = 32
"""Measured states used as initial fields of a chaotic plant, for which no fields are drawn."""
CLOSE = 0.2
"""Share by which no control may cost more than a law on the model, to be rolled out as well."""
FIRST_GAIN = 2e-2
"""`least_gain` before the last renewal."""
FIRST_RENEWAL = 6
"""Rollouts before the first improvement, explorations included; then at least twice as many each
time."""
READINGS_TRUST = 1.0
"""Weight of the distance from the start of a step on a model of readings: for a linear plant the step
is 1/(1 + weight) of the full one."""


@dataclass(frozen=True, kw_only=True)
class ModelBasedSettings(Settings):
    """The constants of `model_based`.

    All are dimensionless: costs and gains are scaled by those of the initial law.
    """

    judging: int = setting(3, "rollouts of the final law on fresh fields", 1, 100)
    believed: float = setting(
        0.05,
        "largest E at which a model is used; above it, laws are steps along rollouts",
        0.0,
        1.0,
    )
    mixtures: int = setting(
        24, "most initial fields that are drawn; half as many before the final law", 0, 1000
    )
    most_mixtures: int = setting(
        96, "the same for a final law that fields left out do not confirm", 0, 1000
    )
    iterations: int = setting(100, "maximum number of L-BFGS steps per improvement", 1, 10_000)
    least_gain: float = setting(
        1e-3, "relative gain in a window of steps with which a descent continues", 0.0, 1.0
    )
    confidence: float = setting(
        1.0, "standard errors, if exact, by which a law must beat the first one", 0.0, 10.0
    )
    enough_fields: int = setting(
        48, "number of measured fields at which improvements stop", 2, 1_000_000
    )
    observer_iterations: int = setting(
        400, "as iterations, for the last one of an observer of few sensors", 1, 10_000
    )
    filter_unpredicted: float = setting(
        0.04,
        "share of a field's size that a filter adds to a reading's noise, 1 to 6 times",
        0.0,
        1.0,
    )
    filter_margin: float = setting(
        0.03, "share of the cost that a filter may add by trusting the equation less", 0.0, 1.0
    )
