# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Initial fields of rollouts from few readings, for a known equation of the field.

Each is estimated separately, as in `pdeloop.method.models.sensed_fit`. The prior comes from all
rollouts: Fourier coefficients are normal with the standard deviations that maximise the likelihood of
all readings, by the fixed point of MacKay, sigma_k^2 = sum x_k^2 / sum (1 - C_kk /
sigma_k^2) with C the covariance of a coefficient given the readings.

References
----------
MacKay, "Bayesian interpolation", Neural Computation 4(3), 1992.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models.sensed import WAVES, Actuators, coefficients_of, field_of, grid_points
from pdeloop.method.models.sensed_problem import SensedProblem
from pdeloop.method.models.settings import DEFAULTS, FieldModelSettings

_SETTLED = 0.05
"""Relative change of the spread of waves below which nothing is fitted again."""
_LEAST_TOLD = 0.05
"""Minimum share of a coefficient that a rollout is taken to determine."""
_LEAST_SPREAD = 1e-2
"""Minimum spread of a wave, relative to the largest."""


@dataclass(frozen=True, eq=False)
class Smoothing:
    """Initial fields of rollouts of a known equation, each found by itself.

    Attributes
    ----------
    shared : (44 + n_a,) array
        The equation's unknowns.
    actuators : Actuators
        What is declared of them.
    noise : float
        Standard deviation of the noise on every reading.
    target : (n_y,) array
        z_r at the sensors.
    spread : (33,) array, optional
        Standard deviations of the Fourier coefficients of a field; those that readings of any size
        suggest if there are none.
    settings : FieldModelSettings
        The constants of the fits, `sensed_`.
    """

    shared: Array
    actuators: Actuators
    noise: float
    target: Array
    spread: Array | None = None
    settings: FieldModelSettings = DEFAULTS

    def field(self, readings: Array, actions: Array, distance: float) -> tuple[Array, float]:
        """The initial field (n,) and its error, as for `fit_sensed`; infinite where nothing is finite.

        readings, actions (T, n_y) and (T, n_a); distance: d, NaN where it is not known.
        """
        problem = self._problem(readings, actions, distance)
        error, _, fields = problem.fit(self.shared, problem.interpolated(), known=True)
        n = grid_points(readings.shape[1])
        field: Array = field_of(fields, n)[0]
        return field, max(error - problem.noise, 0.0)

    def learned(
        self, rollouts: Sequence[tuple[Array, Array, float]], near: Array | None = None
    ) -> Smoothing:
        """With the spread that makes these rollouts likeliest: readings, actions and distance of each.

        Components of a field that the readings do not determine then have their likely size, not that
        of the noise.
        near (rollouts, n): initial fields that an earlier fit of the rollouts found with the equation.
        The iterations start from the spread, if there is one.
        """
        problems = [self._problem(*rollout) for rollout in rollouts]
        if near is None:
            found = [p.fit(self.shared, p.interpolated(), known=True)[2] for p in problems]
        else:
            fields = coefficients_of(near)[:, None]
            found = [p.refined(self.shared, x) for p, x in zip(problems, fields, strict=True)]
        spread = self.spread
        if spread is None:
            spread = np.mean([problem.prior.suggested for problem in problems], axis=0)
        settings = self.settings
        for _ in range(settings.sensed_learning):
            before = spread
            size, told = np.zeros(len(spread)), np.zeros(len(spread))
            for problem, fields in zip(problems, found, strict=True):
                size += fields[0] ** 2
                told += 1.0 - problem.variances(self.shared, fields) / spread**2
            told = np.maximum(told, _LEAST_TOLD * len(problems))
            spread = _falling(size, told)
            for i, problem in enumerate(problems):
                problem.prior.spread = spread
                found[i] = problem.refined(self.shared, found[i])
            if settled(spread, before):
                break
        return replace(self, spread=spread)

    def _problem(self, readings: Array, actions: Array, distance: float) -> SensedProblem:
        # Readings that a law brings to the target say little of the size of the field before.
        first = float(np.sqrt(np.mean(readings[0] ** 2)))
        problem = SensedProblem(
            readings[None],
            actions[None],
            self.actuators,
            self.noise,
            self.target,
            np.array([distance]),
            self.settings,
            least=first,
        )
        problem.prior.spread = self.spread
        return problem


def settled(spread: Array, before: Array) -> bool:
    """True if a spread is as good as the one before."""
    return bool(np.linalg.norm(spread - before) <= _SETTLED * np.linalg.norm(before))


def _falling(size: Array, told: Array) -> Array:
    """The square root of size / told, alike for cosine and sine, and not rising with the wavenumber.

    Between sensors a short wave looks like a long one, which is the likelier one.
    """
    squares, weights = (
        np.mean([part[1 : WAVES + 1], part[WAVES + 1 :]], axis=0) for part in (size, told)
    )
    # Not at the top: a node that smooths no readings has no need of it.
    from scipy.optimize import isotonic_regression

    waves = isotonic_regression(squares / weights, weights=weights, increasing=False).x
    variances = np.concatenate([size[:1] / told[:1], waves, waves])
    found: Array = np.sqrt(np.maximum(variances, _LEAST_SPREAD**2 * variances.max()))
    return found
