# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of the models of the whole field: how they are fitted, and how a kind is chosen."""

from __future__ import annotations

from dataclasses import dataclass

from pdeloop.method.settings import Settings, setting

COEFFICIENT_RIDGE = 1e-9
"""Ridge of the normal equations in normalised columns."""
POINT_SAMPLES = 800
"""Maximum number of data steps in a fit of finite differences."""
LEAST_CORRECTION = 0.02
"""Minimum share of an innovation that corrects a filtered state."""
FAR = 1e3
"""Multiple of the largest measured value beyond which a prediction is discarded."""
NOISE_MISJUDGED = 2.0
"""Ratio of the noise in the data to the declared noise, or its inverse, from which they count as
different."""
BETTER = 3.0
"""How many times smaller the E of a kind with more unknowns must be for it to be selected."""
SENSED_NEWEST = 8
"""Maximum number of rollouts in a fit, the newest ones."""
SENSED_REPRODUCED = 0.05
"""Maximum error of an equation that is used."""
SENSED_MOST = 32
"""Maximum number of point sensors between which a field is estimated."""


@dataclass(frozen=True, kw_only=True)
class FieldModelSettings(Settings):
    """Constants of fitting and choosing models of the whole field.

    All are dimensionless: fields, inputs and time are scaled by the data. E is the squared error of
    a simulated rollout over the sum of |z - z_r|^2.
    """

    # The choice of a kind.
    reproduced: float = setting(2e-3, "E at which the first kind to reach it is selected", 0, 1)
    folds: int = setting(3, "maximum number of cross-validation folds over rollouts", 2, 100)
    worst: float = setting(2.0, "E assigned to a model that diverges", 1, 1e6)
    largest_degree: int = setting(7, "largest degree in z of the kinds that are tried", 2, 7)
    # Spectral models.
    substeps: int = setting(64, "maximum number of internal steps per sampling time", 1, 1000)
    reach: float = setting(
        1.5, "fastest nonlinear rate times the internal step; ETDRK4 is stable up to 2.8", 0.1, 2.8
    )
    # The field between few sensors. "Error" is the squared error of simulated readings over their sum
    # of squares, without the share of the noise.
    sensed_unresolved: float = setting(
        0.005, "share of the readings that counts as noise, as the grid does not resolve it", 0, 1
    )
    sensed_growth: float = setting(
        0.5, "maximum growth of a wave per sampling time, as an exponent of e", 0, 10
    )


DEFAULTS = FieldModelSettings()
