# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of the optimiser `model_based`: how a law is improved on a model, and judged."""

from __future__ import annotations

from dataclasses import dataclass

from loop_method.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class ModelBasedSettings(Settings):
    """What can be set.

    Nothing has a unit: costs and gains are scaled by those of the law that an improvement begins with.
    """

    first_renewal: int = setting(
        6,
        "rollouts, explorations among them, after which the law is improved for the first time, then "
        "after at least twice as many each time, at last before those that judge",
        2,
        1_000_000,
    )
    judging: int = setting(3, "rollouts of the final law on fresh fields", 1, 100)
    enough_fields: int = setting(
        48, "measured fields from which on a law is not improved any more", 2, 1_000_000
    )
    believed: float = setting(
        0.05,
        "largest error E of a model on which a law is improved: the squared error of a simulated "
        "rollout over its squared distance from the target; above it there are local steps",
        0.0,
        1.0,
    )
    believed_noisy: float = setting(
        0.3,
        "the same where states are measured with noise: local models know no more then",
        0.0,
        1.0,
    )
    mixtures: int = setting(
        24,
        "initial fields drawn around the measured ones, at most; half as many where the law is not the "
        "final one",
        0,
        1000,
    )
    chaotic_fields: int = setting(
        32,
        "measured states that are taken for initial fields of a chaotic plant, which forgets where it "
        "began; no fields are drawn then",
        4,
        1000,
    )
    measured_share: float = setting(
        0.5, "weight of the measured fields against the drawn ones", 0.0, 1.0
    )
    iterations: int = setting(100, "steps of L-BFGS of an improvement, at most", 1, 10_000)
    memory: int = setting(40, "differences of gradients that L-BFGS keeps", 1, 1000)
    window: int = setting(
        5, "steps of L-BFGS that together have to gain the share least_gain", 1, 100
    )
    least_gain: float = setting(
        1e-3,
        "share of the cost that a window of steps must gain for the descent to continue",
        0.0,
        1.0,
    )
    first_gain: float = setting(
        2e-2, "the same for every renewal but the last, which continues from there", 0.0, 1.0
    )
    isotropy: float = setting(
        1e-3,
        "share of the identity, in the units of s and of the constant, in the second moment of [s; 1] "
        "by which gains are scaled",
        1e-12,
        1.0,
    )
    halvings: int = setting(12, "times a law is halved until the model's fields are finite", 0, 100)
    folds: int = setting(
        2,
        "parts of the measured fields of which each is left out once, to choose how far the law moves "
        "from the first one",
        2,
        100,
    )
    fractions: int = setting(
        4, "equal shares of the way from the first law to the improved one to choose from", 1, 100
    )
    close: float = setting(
        0.2,
        "share by which no control may cost more than the law on the model, to be rolled out as well",
        0.0,
        10.0,
    )
    confidence: float = setting(
        1.0,
        "standard errors by which a law has to be better on fields that did not make it, to be "
        "preferred to the first one",
        0.0,
        10.0,
    )
