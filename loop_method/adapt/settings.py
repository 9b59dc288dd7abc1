# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of `model_based` and `gauss_newton`: how a law is improved, and judged."""

from __future__ import annotations

from dataclasses import dataclass

from loop_method.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class ModelBasedSettings(Settings):
    """The constants of `model_based`.

    Nothing has a unit: costs and gains are scaled by those of the law that an improvement begins with.
    """

    first_renewal: int = setting(
        6,
        "rollouts before the first improvement, explorations included; then at least twice as many "
        "each time",
        2,
        1_000_000,
    )
    judging: int = setting(3, "rollouts of the final law on fresh fields", 1, 100)
    enough_fields: int = setting(
        48, "number of measured fields at which improvements stop", 2, 1_000_000
    )
    believed: float = setting(
        0.05,
        "largest error E at which a model is used; above it, local steps are taken",
        0.0,
        1.0,
    )
    believed_noisy: float = setting(
        0.3,
        "the same with measurement noise",
        0.0,
        1.0,
    )
    readings_trust: float = setting(
        1.0,
        "weight of the distance from the start of a step on a model of readings; for a linear "
        "plant the step is 1/(1 + weight) of the full one",
        0.0,
        1e6,
    )
    mixtures: int = setting(
        24,
        "maximum number of initial fields drawn around the measured ones; half as many before "
        "the final law",
        0,
        1000,
    )
    chaotic_fields: int = setting(
        32,
        "measured states used as initial fields of a chaotic plant, for which no fields are drawn",
        4,
        1000,
    )
    measured_share: float = setting(
        0.5, "weight of the measured fields against the drawn ones", 0.0, 1.0
    )
    iterations: int = setting(100, "maximum number of L-BFGS steps per improvement", 1, 10_000)
    memory: int = setting(40, "gradient differences that L-BFGS keeps", 1, 1000)
    window: int = setting(5, "L-BFGS steps that together must gain least_gain", 1, 100)
    least_gain: float = setting(
        1e-3,
        "share of the cost by which a window must reduce it for the descent to continue",
        0.0,
        1.0,
    )
    first_gain: float = setting(2e-2, "the same before the last renewal", 0.0, 1.0)
    isotropy: float = setting(
        1e-3,
        "share of the identity in the second moment of [s; 1] that scales the gains",
        1e-12,
        1.0,
    )
    halvings: int = setting(
        12, "maximum number of halvings of a law until the model's fields are finite", 0, 100
    )
    folds: int = setting(
        2,
        "parts of the fields, each held out once to choose how far the law moves",
        2,
        100,
    )
    fractions: int = setting(
        4, "equal steps from the first law to the improved one to choose from", 1, 100
    )
    close: float = setting(
        0.2,
        "no control is also rolled out if its cost on the model exceeds the law's by at most "
        "this share",
        0.0,
        10.0,
    )
    confidence: float = setting(
        1.0,
        "standard errors by which a law must beat the first one on held-out fields",
        0.0,
        10.0,
    )


@dataclass(frozen=True, kw_only=True)
class GaussNewtonSettings(Settings):
    """The constants of `gauss_newton`."""

    fields: int = setting(
        3,
        "initial fields M on which a policy is judged at first; their number grows to 2M",
        1,
        1000,
    )
