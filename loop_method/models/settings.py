# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of the models of the whole field: how they are fitted, and how a kind is chosen."""

from __future__ import annotations

from dataclasses import dataclass

from loop_method.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class FieldModelSettings(Settings):
    """Constants of fitting and choosing models of the whole field.

    All are dimensionless: fields, inputs and time are scaled by the data. E is the squared error of
    a simulated rollout over the sum of |z - z_r|^2.
    """

    # The choice of a kind.
    reproduced: float = setting(2e-3, "E at which the first kind to reach it is selected", 0, 1)
    reproduced_noisy: float = setting(
        0.05, "the same with measurement noise, which leaves initial states uncertain", 0, 1
    )
    better: float = setting(
        3.0,
        "how many times smaller the E of a kind with more unknowns must be for it to be selected",
        1,
        100,
    )
    folds: int = setting(3, "maximum number of cross-validation folds over rollouts", 2, 100)
    hopeless: float = setting(
        20.0,
        "multiple of the best E, or of `reproduced`, above which a kind is dropped from further "
        "folds",
        1,
        1e6,
    )
    worst: float = setting(2.0, "E assigned to a model that diverges", 1, 1e6)
    dense: int = setting(
        512,
        "largest state for the kinds whose cost grows with its square, and for models of neighbours",
        2,
        65536,
    )
    largest_degree: int = setting(7, "largest degree in z of the kinds that are tried", 2, 7)
    fewest_points: int = setting(8, "minimum number of grid points of a spectral model", 4, 65536)
    # Spectral models.
    passes: int = setting(
        12,
        "number of times that an equation is refitted along the paths of the previous fit",
        1,
        20,
    )
    settled: float = setting(
        1e-3, "relative change of the one-step error at which the passes end", 0, 0.1
    )
    samples: int = setting(500, "maximum number of data steps in a fit", 50, 1_000_000)
    substeps: int = setting(64, "maximum number of internal steps per sampling time", 1, 1000)
    first_substeps: int = setting(6, "internal steps of the first pass", 1, 1000)
    reach: float = setting(
        1.5, "fastest nonlinear rate times the internal step; ETDRK4 is stable up to 2.8", 0.1, 2.8
    )
    coefficient_ridge: float = setting(
        1e-9, "ridge of the normal equations in normalised columns", 0, 1e-3
    )
    symbol_ridge: float = setting(
        1e-7, "ridge of a free symbol, relative to the mean square of its column", 0, 1e-3
    )
    clip: float = setting(
        1.2, "bound on z in powers above the third, relative to the largest measured value", 1, 10
    )
    # Finite-difference, convolution and low-rank models.
    point_passes: int = setting(4, "as `passes`, for finite-difference models", 1, 20)
    point_samples: int = setting(800, "as `samples`, for finite-difference models", 50, 1_000_000)
    point_substeps: int = setting(32, "as `substeps`, for finite-difference models", 2, 1000)
    point_reach: float = setting(
        2.5, "as `reach`, for finite-difference models, whose rule is of order 4", 0.1, 2.8
    )
    near_needed: float = setting(
        0.05, "least E of the other kinds above which models of neighbours are tried", 0, 10
    )
    near_screened: float = setting(
        0.1,
        "share of the change that may be unexplained along straight paths between samples",
        0,
        1,
    )
    near_hopeless: float = setting(0.05, "the same along the paths of that fit", 0, 1)
    near_substeps: int = setting(8, "maximum number of internal steps of these paths", 2, 1000)
    near_passes: int = setting(
        8, "further passes of a model of neighbours, on what its steps miss", 1, 50
    )
    near_samples: int = setting(400, "as `samples`, for models of neighbours", 50, 1_000_000)
    near_settled: float = setting(
        0.1, "relative change of what its steps miss at which the passes end", 0, 1
    )
    near_reach: float = setting(0.5, "as `point_reach`, for models of neighbours", 0.1, 2.8)
    near_dropped: float = setting(
        0.5, "share by which its residual may grow when products are left out", 0, 100
    )
    near_negligible: float = setting(
        1e-12, "squared error that counts as none there, as a share of the squared change", 0, 1
    )
    sparse_numbers: int = setting(
        40, "largest state for models of few products of any of its numbers", 1, 64
    )
    sparse_products: int = setting(
        2500,
        "number of products above which products of three different numbers are not tried",
        1,
        100_000,
    )
    sparse_terms: int = setting(8, "maximum number of products for each number", 1, 100)
    sparse_left: float = setting(
        0.5, "share of the remaining squared change that another product may leave", 0, 1
    )
    coarse_points: int = setting(
        256,
        "maximum number of grid points of finite-difference models on several axes; every n-th "
        "point is used on finer grids",
        16,
        65536,
    )
    convolution_ridge: float = setting(1e-9, "ridge of convolution models", 0, 1e-3)
    low_rank_ridge: float = setting(1e-12, "ridge of low-rank models", 0, 1e-3)
    snapshots: int = setting(
        400, "maximum number of states that POD modes are computed from", 2, 10_000
    )
    energy: float = setting(1e-12, "share of the energy below which a POD mode is left out", 0, 1)
    samples_per_mode: int = setting(
        4, "data steps per unknown in a row of a low-rank model", 1, 1000
    )
    # Fits to noisy data.
    noisy_steps: int = setting(
        2000, "maximum number of data steps in a fit with measurement noise", 50, 1_000_000
    )
    noisy_power: float = setting(
        3.0, "mean power of a wavenumber, relative to the noise, from which it is compared", 1, 1e6
    )
    fewest_modes: int = setting(
        4, "wavenumbers that are always compared, whatever their power", 1, 65536
    )
    largest_window: int = setting(16, "maximum number of sampling times in a window", 1, 16)
    growth: float = setting(
        1.5, "largest growth of the linear part within a window, as an exponent of e", 0.1, 10
    )
    relative_error: float = setting(
        0.02, "model error of a window as a share of the change within it", 0, 1
    )
    significance: float = setting(
        3.0, "multiple of its standard error that a coefficient must reach to be kept", 0, 100
    )
    least_correction: float = setting(
        0.02, "minimum share of an innovation that corrects a filtered state", 0, 1
    )
    far: float = setting(
        1e3,
        "multiple of the largest measured value beyond which a prediction is discarded",
        1,
        1e12,
    )
    # Noise that was not declared, or not as it is.
    noise_misjudged: float = setting(
        2.0,
        "ratio of the noise in the data to the declared noise, or its inverse, from which they "
        "count as different",
        1.1,
        100,
    )
    noise_excess: float = setting(
        1.3,
        "largest root mean square of the innovations of an equation, relative to the noise",
        1,
        10,
    )
    white_level: float = setting(
        0.01, "rate at which the test for white innovations rejects independent noise", 1e-6, 0.5
    )
    white_tolerance: float = setting(
        0.5, "root sum of squares of the correlations of innovations that counts as white", 0, 10
    )
    # The field between few sensors. "Error" is the squared error of simulated readings over their sum
    # of squares, without the share of the noise.
    sensed_most: int = setting(
        32, "maximum number of point sensors between which a field is estimated", 1, 1000
    )
    sensed_reproduced: float = setting(0.05, "maximum error of an equation that is used", 0, 1)
    sensed_hopeless: float = setting(
        0.1, "error over any part of the rollouts at which a start of the fit is abandoned", 0, 10
    )
    sensed_unresolved: float = setting(
        0.005, "share of the readings that counts as noise, as the grid does not resolve it", 0, 1
    )
    sensed_enough: float = setting(
        1e-5, "error at which no other dispersion is tried as a start", 0, 1
    )
    sensed_further: int = setting(
        4,
        "maximum number of terms that are added where the first ones do not reproduce readings",
        0,
        12,
    )
    sensed_further_fall: float = setting(
        0.01, "share by which a further term must promise to reduce the error", 0, 1
    )
    sensed_further_chi: float = setting(
        12.0, "the same relative to the variance that noise alone gives", 0, 1000
    )
    sensed_further_worse: float = setting(
        2.0, "growth of the error at which no further term is added", 1, 1000
    )
    sensed_varying: float = setting(
        3e-4,
        "error of an equation with constant coefficients, fitted from nothing, above which "
        "coefficients that depend on x are tried",
        0,
        1,
    )
    sensed_newest: int = setting(8, "maximum number of rollouts in a fit, the newest ones", 1, 1000)
    sensed_attempts: int = setting(
        5, "maximum number of times that an equation is looked for in vain", 1, 1000
    )
    sensed_starts: int = setting(
        8, "maximum number of sets of a few rollouts from which an equation is looked for", 1, 1000
    )
    sensed_largest_cost: float = setting(
        3.0, "maximum cost of a rollout in a fit, per cost of the exploration", 1, 1e6
    )
    sensed_again: int = setting(
        2,
        "further fits with measurement noise, each with the spread of waves that the last one implies",
        0,
        100,
    )
    sensed_likelier: float = setting(
        30.0,
        "margin in log-likelihood by which a fit from nothing, without the spread of waves that "
        "followed from an earlier equation, must exceed the fit with it",
        0,
        1e6,
    )
    sensed_beginning: float = setting(
        0.05, "share of each rollout over which a fit begins", 1e-3, 1
    )
    sensed_shortest: int = setting(10, "minimum number of its time steps", 2, 1_000_000)
    sensed_continuation: float = setting(
        1.6, "factor by which this share then grows, until the rollouts are whole", 1.1, 1000
    )
    sensed_iterations: int = setting(
        20, "maximum number of iterations of a fit over a part of the rollouts", 1, 1000
    )
    sensed_last_iterations: int = setting(60, "the same over whole rollouts", 1, 1000)
    sensed_least_gain: float = setting(
        1e-3, "share by which an iteration must reduce the error for the fit to continue", 0, 1
    )
    sensed_damping: float = setting(
        1e-2, "initial damping of the Levenberg-Marquardt method", 1e-9, 1e4
    )
    sensed_difference: float = setting(1e-5, "step of the finite differences", 1e-9, 1e-2)
    sensed_compared: int = setting(
        100, "maximum number of time steps whose readings are compared", 2, 1_000_000
    )
    sensed_distance: float = setting(
        0.1,
        "weight of the relative error of the distance from the target, which is known from a cost",
        0,
        10,
    )
    sensed_dispersion: float = setting(
        20.0,
        "dispersion at which fits start, of both signs; also half of it and 1.5 times it",
        0,
        1e6,
    )
    sensed_growth: float = setting(
        0.5, "maximum growth of a wave per sampling time, as an exponent of e", 0, 10
    )
    sensed_margin: float = setting(
        1.25,
        "assumed maximum of the field, relative to the readings, that sets the internal steps",
        1,
        100,
    )
    sensed_clip: float = setting(
        2.0, "bound on z in powers during a fit, relative to the largest reading", 1, 100
    )
    sensed_extrapolation: float = setting(
        1.5, "maximum of simulated fields, relative to the estimated initial ones", 1, 100
    )
    sensed_ridge: float = setting(1e-5, "ridge of the unknowns of the equation", 0, 1)
    sensed_place_ridge: float = setting(
        1e-3,
        "ridge of the shifts, widths and differences of actuators while no equation is known",
        0,
        1,
    )
    sensed_held_ridge: float = setting(
        0.1,
        "the same with measurement noise, until whole rollouts are fitted",
        0,
        1e6,
    )
    sensed_unequal_ridge: float = setting(1e-4, "ridge of the differences between actuators", 0, 1)
    sensed_alike_chi: float = setting(
        4.0,
        "fall of an error, in standard deviations of the part due to noise, from which "
        "differences between actuators, or coefficients that depend on x, count",
        0,
        1000,
    )
    sensed_alike_ridge: float = setting(
        1e-2, "ridge of these differences while the actuators are held close to one strength", 0, 1
    )
    sensed_deviation: float = setting(
        10.0,
        "prior standard deviation of the unknowns of the equation, with measurement noise",
        1e-6,
        1e12,
    )
    sensed_unequal: float = setting(
        1.0, "the same for the differences between actuators", 1e-6, 1e12
    )
    sensed_alike_unequal: float = setting(0.1, "the same while they are held close", 1e-6, 1e12)
    sensed_field_ridge: float = setting(
        1e-3, "ridge of the Fourier coefficients of an initial field", 0, 1
    )
    sensed_field_deviation: float = setting(
        0.5,
        "prior standard deviation of these coefficients relative to the readings, with noise",
        1e-6,
        1e6,
    )
    sensed_field_wave: float = setting(
        4.0, "wavenumber beyond which both grow stricter with its square", 0.1, 1e3
    )
    sensed_learning: int = setting(
        5, "maximum number of iterations towards the most likely spread of waves", 0, 100
    )
    sensed_settled: float = setting(
        0.05, "relative change of this spread below which nothing is iterated or fitted again", 0, 1
    )
    sensed_least_told: float = setting(
        0.05, "minimum share of a coefficient that a rollout is taken to determine", 1e-6, 1
    )
    sensed_least_spread: float = setting(
        1e-2, "minimum spread of a wave, relative to the largest", 1e-9, 1
    )


DEFAULTS = FieldModelSettings()
