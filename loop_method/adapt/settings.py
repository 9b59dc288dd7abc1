# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of the optimiser `model_based`, with their meaning and range."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ModelBasedSettings:
    """How a law is improved on a model of the whole field, and judged by rollouts.

    None has a unit: costs and gains are scaled by those of the law that an improvement begins with.

    Attributes
    ----------
    first_renewal : int
        Rollouts, explorations among them, after which the law is improved for the first time, at least
        2; every further improvement comes after twice as many, and the last one before the rollouts
        that judge.
    judging : int
        Rollouts of the final law on fresh fields, 1 to 100.
    believed : float
        Largest error E of a model on which a law is improved, 0 to 1: the squared error of a
        simulated rollout over the sum of |z - z_r|^2. Above it there are local steps instead.
    mixtures : int
        Initial fields drawn around the measured ones, 2 to 1000.
    measured_share : float
        Weight of the measured fields against the drawn ones, 0 to 1.
    most_fields : int
        Measured fields that a law is improved on, the newest, at least 2.
    iterations : int
        Steps of L-BFGS of an improvement, at most, 1 to 10000.
    memory : int
        Differences of gradients that L-BFGS keeps, 1 to 1000.
    window, least_gain : int, float
        L-BFGS stops when that many steps, 1 to 100, together lower the cost by no more than this
        share, 0 to 1.
    isotropy : float
        Share of the identity, in the units of s and of the constant, in the second moment of [s; 1] by
        which gains are scaled, 1e-12 to 1.
    halvings : int
        Times that a law is halved until the model's fields stay finite, 0 to 100.
    folds : int
        Parts of the measured fields of which each is left out once, to choose how far the law moves
        from the first one, at least 2.
    fractions : tuple of float
        Shares of the way from the first law to the improved one among which is chosen, 0 to 1.
    confidence : float
        Standard errors by which a law has to be better on measured fields that did not make it, to be
        preferred to the first one, 0 to 10.
    """

    first_renewal: int = 6
    judging: int = 3
    believed: float = 0.05
    mixtures: int = 24
    measured_share: float = 0.5
    most_fields: int = 48
    iterations: int = 60
    memory: int = 40
    window: int = 5
    least_gain: float = 2e-3
    isotropy: float = 1e-3
    halvings: int = 12
    folds: int = 2
    fractions: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0)
    confidence: float = 1.0
