# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The constants of the field models, with their meaning and range."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class FieldModelSettings:
    """Constants of fitting and choosing models of the whole field.

    None has a unit: fields, inputs and time are scaled by what the data hold.

    Attributes
    ----------
    passes : int
        Times that an equation is fitted along the paths of the last one, 1 to 20.
    settled : float
        Passes end where the error of a step of the plant changes by no more than this share, 0 to
        0.1.
    samples : int
        Steps of the plant that it is fitted to, at most, at least 50.
    substeps : int
        Internal steps of a sampling time, at most, 1 to 1000.
    first_substeps : int
        Those of the first pass, which has no equation yet, 1 to `substeps`.
    reach : float
        Fastest nonlinear rate times the internal step, 0.1 to 2.8: where ETDRK4 is stable.
    coefficient_ridge : float
        Of the normal equations in normalised columns, 0 to 1e-3.
    symbol_ridge : float
        Of a symbol that is free at every wavenumber, per mean square of its column, 0 to 1e-3.
    clip : float
        Largest |z| in powers above the third, per max |z| measured, 1 to 10: a polynomial of high
        degree says nothing beyond the data.
    point_passes, point_samples : int
        As `passes` and `samples`, of coefficients that depend on the place.
    point_substeps : int
        As `substeps`, of the finite-difference models.
    point_reach : float
        As `reach`, of the Runge-Kutta rule of order 4.
    reproduced : float
        E up to which the first kind that reaches it is taken, 0 to 1; E is the squared error of a
        simulated rollout over the sum of |z - z_r|^2.
    better : float
        How many times smaller the E of a richer kind must be, 1 to 100.
    folds : int
        Turns in which rollouts are fitted and judged, at most, at least 2.
    hopeless : float
        How many times worse than the best one, or than `reproduced`, a kind gets no other turn, at
        least 1.
    worst : float
        The E that counts for a model that diverges, at least 1.
    dense : int
        Largest state of models whose work grows with its square, at least 2.
    reproduced_noisy : float
        As `reproduced`, where there is measurement noise, which leaves initial states uncertain.
    noisy_steps : int
        As `samples`, of data with measurement noise, at least 50.
    noisy_power : float
        Times the power of the noise that a wavenumber must have on the average to be compared, at
        least 1.
    significance : float
        Standard errors that a coefficient must have to be kept where there is noise, 0 to 10.
    least_correction : float
        Least share of an innovation that corrects the states, 0 to 1.
    growth : float
        Largest growth of the linear part within a window, in powers of e, 0.1 to 10.
    relative_error : float
        Error of a window, besides the noise, as a share of the change within it, 0 to 1.
    """

    passes: int = 12
    settled: float = 1e-3
    samples: int = 500
    substeps: int = 64
    first_substeps: int = 6
    reach: float = 1.5
    coefficient_ridge: float = 1e-9
    symbol_ridge: float = 1e-7
    clip: float = 1.2
    point_passes: int = 4
    point_samples: int = 800
    point_substeps: int = 32
    point_reach: float = 2.5
    reproduced: float = 2e-3
    better: float = 3.0
    folds: int = 3
    hopeless: float = 20.0
    worst: float = 2.0
    dense: int = 512
    reproduced_noisy: float = 0.05
    noisy_steps: int = 2000
    noisy_power: float = 3.0
    significance: float = 3.0
    least_correction: float = 0.02
    growth: float = 1.5
    relative_error: float = 0.02
