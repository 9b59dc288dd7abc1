# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The equation of `loop_method.models.sensed` and initial fields from the readings of rollouts.

The initial fields of the rollouts are unknown as well: a few Fourier coefficients each. All of them are
fitted at once to the readings y_k = z_k(sensors) of whole rollouts, and to d, the mean of (z - z_r)^2
over all points and steps of each, which follows from its cost,

    min  mean over rollouts and steps |y_k^model - y_k|^2 / mean |y_k|^2
         + mean over rollouts (0.1 (d^model / d - 1))^2 + a small ridge,

by the method of Levenberg and Marquardt, first over the beginning of the rollouts and then
further. The field between the sensors is observed later, when it passes one.

References
----------
Le Dimet, Talagrand, "Variational algorithms for analysis and assimilation of meteorological
observations", Tellus A 38, 1986 (initial fields from readings: 4D-Var). Raissi, Perdikaris,
Karniadakis, "Physics-informed neural networks", J. Comput. Phys. 378, 2019 (equation and field from few
points).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.models.sensed import (
    COEFFICIENTS,
    SHARED,
    TERMS,
    WAVES,
    SensedEquation,
    grid_points,
    interpolated,
    spectrum,
)

# First values of the dispersion c_13, in its unit: no descent leads from waves that run one way
# to waves that run the other.
_DISPERSIONS = (0.0, -20.0, 20.0, -10.0, 10.0, -30.0, 30.0)
# An error with which none of the others is tried.
_ENOUGH = 1e-5
# Shares of the rollouts that are fitted one after the other, and the most steps for each.
_SHARES = (0.2, 0.4, 1.0)
_ITERATIONS, _LAST_ITERATIONS = 20, 60
_COMPARED = 100
# Ridges, on the readings' scale: of the shared unknowns, of those that move and widen the actuators
# as long as no equation is known, and of Fourier coefficients, which grows with the wavenumber. With
# noise there come those of a normal prior, with these standard deviations: of the shared unknowns, and
# of Fourier coefficients relative to the readings.
_SHARED_RIDGE, _PLACE_RIDGE = 1e-5, 1e-3
_FIELD_RIDGE, _FIELD_RIDGE_WAVE = 1e-3, 4.0
_SHARED_DEVIATION, _FIELD_DEVIATION = 10.0, 0.5
_DAMPING = (1e-2, 1e-9, 1e4)
_LEAST_GAIN = 1e-3
# Weight of the relative error of a distance from the target against that of the readings.
_DISTANCE = 0.1
_DIFFERENCE = 1e-5


def fit_sensed(
    readings: Sequence[Array],
    actions: Sequence[Array],
    centres: Array,
    noise: float = 0.0,
    start: Array | None = None,
    target: Array | None = None,
    distances: Array | None = None,
    spread: Array | None = None,
) -> tuple[Array, Array, float]:
    """Fit the equation and the initial fields of rollouts.

    Parameters
    ----------
    readings, actions : sequences of (T, n_y) and (T, n_a) arrays
        Of rollouts of one length: y_k and a_k.
    centres : (n_a,) array
        Of the actuators, as shares of the domain.
    noise : float
        Standard deviation of the noise on every reading.
    start : (12,) array, optional
        The shared unknowns to begin with; from several equations, with no actuators, if there are none.
    target : (n_y,) array, optional
        z_r at the sensors.
    distances : (rollouts,) array, optional
        d of each rollout; NaN where it is not known.
    spread : (33,) array, optional
        Standard deviations of the Fourier coefficients of an initial field; those that readings of any
        size suggest if there are none.

    Returns
    -------
    (12,) array, (rollouts, n) array and float
        The shared unknowns with the least error, the initial fields, and the error: what is minimised,
        but for the ridge and for what noise has in it.
    """
    y, a = np.stack(readings), np.stack(actions)
    if target is None or distances is None:
        target, distances = np.zeros(y.shape[2]), np.full(len(y), np.nan)
    problem = SensedProblem(y, a, centres, noise, target, distances)
    problem.spread = spread
    fields = problem.interpolated()
    if start is None:
        calmest = np.argsort(np.sum(y * y, axis=(1, 2)), kind="stable").tolist()
        acted = [m for m in calmest if a[m].any()]
        pair = list(dict.fromkeys([*acted[:1], *calmest]))[:2]
        shared, fields[pair] = _first_guess(
            SensedProblem(y[pair], a[pair], centres, noise, target, distances[pair], _PLACE_RIDGE)
        )
    else:
        shared = start
    error, shared, fields = problem.fit(shared, fields)
    n = grid_points(y.shape[2])
    return shared, np.fft.irfft(spectrum(fields, n), n), max(error - problem.noise, 0.0)


def _first_guess(problem: SensedProblem) -> tuple[Array, Array]:
    """The best unknowns of a few rollouts, shared and fields, from several equations."""
    least, best = np.inf, (np.zeros(SHARED), problem.interpolated())
    for dispersion in _DISPERSIONS:
        first = np.zeros(SHARED)
        first[TERMS.index((1, 3))] = dispersion
        error, *unknowns = problem.fit(first, problem.interpolated())
        if error < least:
            least, best = error, (unknowns[0], unknowns[1])
        if least <= _ENOUGH + problem.noise:
            break
    return best


class SensedProblem:
    """The least squares problem: readings y (R, T, n_y), actions a (R, T, n_a), distances (R,).

    target, distances: as in `fit_sensed`; least: the least size of the readings that errors are
    relative to. noise becomes what the noise has in the mean square of the readings, as a share of it.
    """

    def __init__(
        self,
        y: Array,
        a: Array,
        centres: Array,
        noise: float,
        target: Array,
        distances: Array,
        place_ridge: float = 0.0,
        least: float = 0.0,
    ) -> None:
        self.y, self.a, self._centres = y, a, centres
        self._size = max(float(np.sqrt(np.mean(y * y))), least) or 1.0
        self.noise: float = (noise / self._size) ** 2
        self._place_ridge = place_ridge
        self.spread: Array | None = None
        sensors = y.shape[2]
        self._n = grid_points(sensors)
        waves = np.arange(self._n // 2 + 1)
        places = (np.arange(sensors) + 0.5) / sensors
        # Of a transform: the field at the sensors.
        twice = np.where((waves == 0) | (waves == self._n // 2), 1.0, 2.0)
        self._read = np.exp(2j * np.pi * waves[:, None] * places) * (twice / self._n)[:, None]
        self._waves = np.r_[0, 1 : WAVES + 1, 1 : WAVES + 1]
        # Times |transform|^2: the mean square of the field.
        self._mean_square = twice / self._n**2
        self._target = np.fft.rfft(interpolated(target))
        self._distances = distances

    def interpolated(self) -> Array:
        """Initial fields from the first readings alone, (R, 33)."""
        sensors = self.y.shape[2]
        places = (np.arange(sensors) + 0.5) / sensors
        grid = np.arange(self._n) / self._n
        fields = np.stack([np.interp(grid, places, y[0], period=1.0) for y in self.y])
        z = np.fft.rfft(fields)[:, : WAVES + 1] / self._n
        return np.hstack([z.real, z.imag[:, 1:]])

    def fit(
        self, shared: Array, fields: Array, *, known: bool = False
    ) -> tuple[float, Array, Array]:
        """The error per reading, relative to their size, and the unknowns.

        known: the shared ones stay as they are.
        """
        for share in _SHARES:
            steps = max(2, round(share * self.y.shape[1]))
            moved = self._descend(shared, fields, steps, known)
            # What fits the beginning may overflow later.
            if np.isfinite(self._error(*moved)):
                shared, fields = moved
        return self._error(shared, fields), shared, fields

    def refined(self, shared: Array, fields: Array) -> Array:
        """The fields that fit best next to these, with the shared unknowns as they are."""
        return self._descend(shared, fields, self.y.shape[1], known=True)[1]

    def variances(self, shared: Array, fields: Array) -> Array:
        """Those of the coefficients of the field of the only rollout, (33,), given its readings."""
        steps = self.y.shape[1]
        with np.errstate(over="ignore", invalid="ignore"):
            J = self._linearised(shared, fields, steps, known=True)[1]
        if not np.isfinite(J).all():
            return np.zeros(len(J))
        inverse = np.linalg.inv(J @ J.T + np.diag(self._ridge(steps)[SHARED:]))
        found: Array = self._weight(steps) * np.diag(inverse)
        return found

    @property
    def suggested(self) -> Array:
        """Standard deviations of the coefficients of a field, (33,), from its size alone."""
        falling = 1.0 + (self._waves / _FIELD_RIDGE_WAVE) ** 2
        found: Array = _FIELD_DEVIATION * self._size / falling
        return found

    def _error(self, shared: Array, fields: Array) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            residuals = self._residuals(shared[None], fields[None], self.y.shape[1])
            error = float(np.sum(residuals**2))
        return error if np.isfinite(error) else np.inf

    def _descend(
        self, shared: Array, fields: Array, steps: int, known: bool
    ) -> tuple[Array, Array]:
        damping, least, most = _DAMPING
        begin = SHARED if known else 0
        ridge = self._ridge(steps)[begin:]
        x = np.concatenate([shared, fields.ravel()])[begin:]

        def parts(x: Array) -> tuple[Array, Array]:
            own = shared if known else x[:SHARED]
            return own, x[SHARED - begin :].reshape(fields.shape)

        def objective(x: Array) -> float:
            shared, fields = parts(x)
            residual = self._residuals(shared[None], fields[None], steps)
            total = float(np.sum(residual**2) + np.sum(ridge * x * x))
            return total if np.isfinite(total) else np.inf

        # Unknowns on the way to a good model may overflow: their error is then infinite.
        with np.errstate(over="ignore", invalid="ignore"):
            now = objective(x)
            for _ in range(_ITERATIONS if steps < self.y.shape[1] else _LAST_ITERATIONS):
                residual, J = self._linearised(*parts(x), steps, known)
                if not np.isfinite(J).all():
                    break
                H, g = J @ J.T, J @ residual + ridge * x
                H[np.diag_indices(x.size)] += ridge
                before = now
                while damping < most:
                    damped = H + np.diag(damping * np.diag(H) + 1e-12)
                    moved = x - np.linalg.solve(damped, g)
                    value = objective(moved)
                    if value < now:
                        x, now = moved, value
                        damping = max(damping / 5.0, least)
                        break
                    damping *= 5.0
                if not now < (1.0 - _LEAST_GAIN) * before:
                    break
        return parts(x)

    def _ridge(self, steps: int) -> Array:
        rollouts, weight = len(self.y), self._weight(steps)
        shared = np.full(SHARED, _SHARED_RIDGE**2 + weight / _SHARED_DEVIATION**2)
        shared[COEFFICIENTS + 1 :] += self._place_ridge**2
        rising = (1.0 + (self._waves / _FIELD_RIDGE_WAVE) ** 2) ** 2 / self._size**2
        if self.spread is None:
            field = (_FIELD_RIDGE**2 / rollouts + weight / _FIELD_DEVIATION**2) * rising
        else:
            field = _FIELD_RIDGE**2 / rollouts * rising + weight / self.spread**2
        return np.concatenate([shared, np.tile(field, rollouts)])

    def _weight(self, steps: int) -> float:
        """The variance of the noise on a residual."""
        rollouts, _, sensors = self.y.shape
        compared = len(range(0, steps, self._stride(steps)))
        return float(self.noise / (compared * sensors * rollouts))

    @staticmethod
    def _stride(steps: int) -> int:
        """Interval between compared steps, for a given number of steps."""
        return -(-steps // _COMPARED)

    def _residuals(self, shared: Array, fields: Array, steps: int) -> Array:
        """Errors for unknowns (P, 12) and (P, R, 33), as shares of the whole: (P, R, errors).

        Those of the readings and, over whole rollouts, that of the distance.
        """
        stride = self._stride(steps)
        equation = SensedEquation(shared[:, None], self._n, self._centres)
        z = spectrum(fields, self._n)
        residuals = []
        distance = np.zeros(z.shape[:2])
        for k in range(steps):
            if k % stride == 0:
                residuals.append((z @ self._read).real - self.y[:, k])
            distance += np.abs(z - self._target) ** 2 @ self._mean_square
            z = equation.step(z, equation.force(self.a[:, k]))
        whole: Array = np.concatenate(residuals, axis=2)
        whole /= self._size * np.sqrt(whole[0].size)
        if steps < self.y.shape[1]:
            return whole
        off = distance / (steps * self._distances) - 1.0
        off = np.where(np.isnan(self._distances), 0.0, off)
        off *= _DISTANCE / np.sqrt(len(self.y))
        return np.concatenate([whole, off[..., None]], axis=2)

    def _linearised(
        self, shared: Array, fields: Array, steps: int, known: bool
    ) -> tuple[Array, Array]:
        """Residuals (r,) and their derivatives (unknowns, r). A field moves its own rollout alone."""
        rollouts, own = fields.shape
        common = 0 if known else SHARED
        count = 1 + common + own
        all_shared, all_fields = np.tile(shared, (count, 1)), np.tile(fields, (count, 1, 1))
        all_shared[1 : 1 + common] += _DIFFERENCE * np.eye(SHARED)[:common]
        all_fields[1 + common :] += _DIFFERENCE * np.eye(own)[:, None]
        residuals = self._residuals(all_shared, all_fields, steps)
        changes = (residuals[1:] - residuals[0]) / _DIFFERENCE
        J = np.zeros((common + rollouts * own, *residuals[0].shape))
        J[:common] = changes[:common]
        for m in range(rollouts):
            J[common + m * own : common + (m + 1) * own, m] = changes[common:, m]
        return residuals[0].ravel(), J.reshape(len(J), -1)
