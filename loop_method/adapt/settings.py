# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of `model_based` and `gauss_newton`: how a law is improved, and judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loop_method.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class ImprovementSettings(Settings):
    """The constants of improving a law on a model, and of the verdict on it.

    All are dimensionless: costs and gains are scaled by those of the initial law.
    """

    judging: int = setting(3, "rollouts of the final law on fresh fields", 1, 100)
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
    mixtures: int = setting(
        24,
        "maximum number of initial fields drawn around the measured ones; half as many before "
        "the final law",
        0,
        1000,
    )
    most_mixtures: int = setting(
        96,
        "the same for the final law if the one from fewer fields is not confirmed by the fields "
        "left out",
        0,
        1000,
    )
    confirmed: float = setting(
        0.5,
        "share of the gain on its own fields that a law must reach on those left out; otherwise "
        "it is made again on more drawn fields",
        0.0,
        1.0,
    )
    chaotic_fields: int = setting(
        32,
        "measured states used as initial fields of a chaotic plant, for which no fields are drawn",
        4,
        1000,
    )
    chaotic_most: int = setting(
        96,
        "the same if the gain of a law from fewer states is not clear on the other states",
        4,
        1000,
    )
    chaotic_clear: float = setting(
        10.0,
        "multiple of the standard errors of the verdict at which this gain is clear",
        0.0,
        100.0,
    )
    chaotic_confirmed: float = setting(
        0.8,
        "share of the gain on its own states that a law must reach on those left out for few "
        "states to suffice",
        0.0,
        1.0,
    )
    pieces: int = setting(
        8, "pieces of a rollout that a model of a chaotic plant must predict", 2, 1000
    )
    chaotic_growth: float = setting(
        20.0, "minimum ratio of the errors on whole rollouts and on pieces", 1.0, 1e6
    )
    measured_share: float = setting(
        0.5, "weight of the measured fields relative to the drawn ones", 0.0, 1.0
    )
    iterations: int = setting(100, "maximum number of L-BFGS steps per improvement", 1, 10_000)
    memory: int = setting(40, "gradient differences that L-BFGS keeps", 1, 1000)
    window: int = setting(5, "L-BFGS steps that together must reach least_gain", 1, 100)
    least_gain: float = setting(
        1e-3,
        "relative reduction of the cost that a window must reach for the descent to continue",
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
        4,
        "number of equal steps from the first law to the improved one, among which one is chosen",
        1,
        100,
    )
    close: float = setting(
        0.2,
        "no control is also rolled out if its cost on the model exceeds the law's by at most "
        "this share",
        0.0,
        10.0,
    )
    pairs: int = setting(
        12,
        "maximum number of fields on which laws are compared by rollouts alone",
        2,
        1000,
    )
    confidence: float = setting(
        1.0,
        "standard errors by which a law must beat the first one if they are known exactly; more "
        "if they are estimated from few rollouts",
        0.0,
        10.0,
    )


@dataclass(frozen=True, kw_only=True)
class ModelBasedSettings(ImprovementSettings):
    """The constants of `model_based`."""

    first_renewal: int = setting(
        6,
        "rollouts before the first improvement, explorations included; then at least twice as many "
        "each time",
        2,
        1_000_000,
    )
    enough_fields: int = setting(
        48, "number of measured fields at which improvements stop", 2, 1_000_000
    )
    observer_iterations: int = setting(
        400,
        "as iterations, for the last improvement of the law observer on a model of the field",
        1,
        10_000,
    )
    observer_gain: float = setting(3e-4, "as least_gain, for that improvement", 0.0, 1.0)
    observer_draws: int = setting(
        2,
        "sets of drawn initial fields, each of at most mixtures, for that improvement and for "
        "the law extended_kalman",
        1,
        100,
    )
    filter_modes: int = setting(
        24, "modes of the field that the law extended_kalman feeds back", 1, 1000
    )
    filter_unpredicted: float = setting(
        0.04,
        "share of the size of a field that its filter adds to the noise of a reading for what no "
        "model predicts; 6 times as much, or else 3 times, where filter_margin allows it",
        0.0,
        1.0,
    )
    filter_inflation: float = setting(
        1.0, "factor by which the standard deviations of its estimate grow in every step", 1.0, 2.0
    )
    filter_seen: float = setting(
        0.2,
        "noise, as a share of the size of a field, for which one of its laws is optimised",
        0.0,
        10.0,
    )
    filter_iterations: int = setting(
        30, "as iterations, for a law on an estimate that is improved through its filter", 1, 10_000
    )
    filter_draws: int = setting(
        4, "sets of drawn initial fields, each of at most mixtures, for such a law", 1, 100
    )
    filter_equations: int = setting(
        1,
        "number of equations, the newest and those before it, on which laws between few sensors "
        "are compared; with more than 1 the last law on an estimate is also improved through its "
        "filter",
        1,
        100,
    )
    filter_margin: float = setting(
        0.03,
        "largest relative increase in the cost on the model at which a filter that trusts the "
        "equation less is still used",
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


@dataclass(frozen=True, kw_only=True)
class GaussNewtonSettings(ImprovementSettings):
    """The constants of `gauss_newton`."""

    isotropy: float = setting(
        0.3,
        "share of the identity in the second moment of [s; 1] that scales the gains",
        1e-12,
        1.0,
    )
    fields: int = setting(
        3,
        "initial fields M on which a policy is judged at first; their number grows to 2M",
        1,
        1000,
    )
    abort: float = setting(
        1.05,
        "multiple of the incumbent's running mean at which a candidate is given up",
        1.0,
        100.0,
    )
    clearly: float = setting(
        2.0,
        "with few sensors, multiple of the standard errors of the verdict at which the rollouts of the "
        "steps themselves decide",
        1.0,
        100.0,
    )
    small_gain: float = setting(
        0.02,
        "gain of an accepted step, as a share of the cost, below which a field is added",
        0.0,
        1.0,
    )
    remembered: int = setting(
        40, "number of newest rollouts to which models are fitted", 1, 1_000_000
    )
    first_damping: float = setting(1.0, "initial damping", 1e-12, 1e12)
    least_damping: float = setting(1e-4, "smallest damping", 1e-12, 1e12)
    largest_damping: float = setting(100.0, "largest damping after a rejection", 1e-12, 1e12)
    good_ratio: float = setting(
        0.5, "ratio of measured to predicted fall above which the damping is reduced", 0.0, 10.0
    )
    poor_ratio: float = setting(0.2, "the same ratio up to which it is raised", 0.0, 10.0)
    damping_fall: float = setting(3.0, "divisor of the damping after a good step", 1.0, 1e6)
    damping_rise: float = setting(2.0, "factor of the damping after a poor step", 1.0, 1e6)
    damping_rejected: float = setting(4.0, "factor of the damping after a rejection", 1.0, 1e6)
    least_fall: float = setting(
        1e-3, "predicted fall, as a share of the cost, below which a step is not tried", 0.0, 1.0
    )
    trust: float = setting(
        0.03,
        "weight of the distance of a step on a model of the whole field, per damping",
        0.0,
        1e6,
    )
    newest: int = setting(
        8, "number of newest initial fields used for a step on such a model", 1, 1000
    )
    extrapolation: float = setting(
        1.5,
        "distance of further fields from the mean of these, relative to that of these fields",
        0.0,
        100.0,
    )
    chaotic_share: int = setting(
        3,
        "of the measured states of a chaotic plant, one in this many makes a law; the others "
        "judge it",
        2,
        100,
    )
    modes: int = setting(32, "coordinates of a local model; never fewer than the law's", 1, 512)
    cubic_modes: int = setting(12, "maximum number of coordinates of its cubic part", 0, 64)
    ridges: int = setting(6, "number of ridges tried for the quadratic and cubic part", 1, 100)
    least_ridge: float = setting(
        1e-6, "smallest of these ridges, relative to a unit weight", 1e-15, 1e6
    )
    largest_ridge: float = setting(1e-1, "largest of these ridges", 1e-15, 1e6)
    linear_ridge: float = setting(1e-5, "ridge of the linear part", 0.0, 1.0)
    action_ridge: float = setting(1e-8, "ridge of the inputs", 0.0, 1.0)
    ageing: float = setting(
        0.9, "weight of a rollout relative to one that is M rollouts newer", 1e-6, 1.0
    )
    least_weight: float = setting(0.3, "smallest such weight", 0.0, 1.0)
    low_forgetting: float = setting(
        5.0, "smallest non-zero forgetting kappa that is tried", 0.0, 1e3
    )
    middle_forgetting: float = setting(15.0, "the next one", 0.0, 1e3)
    high_forgetting: float = setting(50.0, "the largest one", 0.0, 1e3)
    local_cost: float = setting(
        3.0,
        "maximum cost of a rollout that is compared with the incumbent, relative to the cost "
        "of the incumbent",
        1.0,
        1e6,
    )
    worst: float = setting(2.0, "E assigned to a local model that diverges", 1.0, 1e6)
    enough_factor: float = setting(
        1.5,
        "after an acceptance, the smallest kappa is used whose E is at most this multiple of the "
        "minimum",
        1.0,
        1e3,
    )
    alike_factor: float = setting(
        3.0, "models whose E is at most this multiple of the minimum are averaged", 1.0, 1e3
    )
    alike_margin: float = setting(0.03, "added to both of these bounds", 0.0, 2.0)
    alike_distance: float = setting(
        0.15, "maximum difference of these E from the minimum", 0.0, 2.0
    )

    @property
    def ridge_values(self) -> tuple[float, ...]:
        """The ridges, equally spaced in their logarithm."""
        found = np.geomspace(self.least_ridge, self.largest_ridge, self.ridges)
        return tuple(float(f"{ridge:.12g}") for ridge in found)

    @property
    def forgettings(self) -> tuple[float, ...]:
        """The values of kappa."""
        return (0.0, self.low_forgetting, self.middle_forgetting, self.high_forgetting)
