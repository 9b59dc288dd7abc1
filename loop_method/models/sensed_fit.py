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
    unknowns,
)
from loop_method.models.settings import DEFAULTS, FieldModelSettings

# Shares of the declared dispersion that fits begin with: no descent leads from waves that run one way
# to waves that run the other. The last ones are tried only where none of the others is good enough.
_DISPERSIONS, _FEW = (0.0, -1.0, 1.0, -0.5, 0.5, -1.5, 1.5), 3
# Parts of rollouts that tell whether a start is worth going on with, and the share of the error that it
# must have of others'.
_BEGINNINGS, _BETTER = 4, 0.8
# Times that whole rollouts are fitted, each with the unknowns that were significant before.
_WHOLE = 2
# Steps before and after one that also tell how large its field is.
_NEAR = 2
# Least and largest damping.
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e4


def fit_sensed(
    readings: Sequence[Array],
    actions: Sequence[Array],
    centres: Array,
    noise: float = 0.0,
    start: Array | None = None,
    target: Array | None = None,
    distances: Array | None = None,
    spread: Array | None = None,
    settings: FieldModelSettings = DEFAULTS,
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
    start : (12 + n_a,) array, optional
        The shared unknowns to begin with; from several equations, with no actuators, if there are none.
    target : (n_y,) array, optional
        z_r at the sensors.
    distances : (rollouts,) array, optional
        d of each rollout; NaN where it is not known.
    spread : (33,) array, optional
        Standard deviations of the Fourier coefficients of an initial field; those that readings of any
        size suggest if there are none.
    settings : FieldModelSettings
        The constants of the fit, `sensed_`.

    Returns
    -------
    (12 + n_a,) array, (rollouts, n) array and float
        The shared unknowns with the least error, the initial fields, and the error: what is minimised,
        but for the ridge and for what noise has in it. It is infinite where no equation reproduces even
        the beginning of the rollouts.
    """
    y, a = np.stack(readings), np.stack(actions)
    if target is None or distances is None:
        target, distances = np.zeros(y.shape[2]), np.full(len(y), np.nan)
    problem = SensedProblem(y, a, centres, noise, target, distances, settings)
    problem.spread = spread
    fields, n = problem.interpolated(), grid_points(y.shape[2])
    if start is None:
        calmest = np.argsort(np.sum(y * y, axis=(1, 2)), kind="stable").tolist()
        acted = [m for m in calmest if a[m].any()]
        pair = list(dict.fromkeys([*acted[:1], *calmest]))[:2]
        few = SensedProblem(
            *(y[pair], a[pair], centres, noise, target, distances[pair], settings),
            settings.sensed_place_ridge,
        )
        error, shared, fields[pair] = _first_guess(few, settings)
        if not np.isfinite(error):
            return shared, np.fft.irfft(spectrum(fields, n), n), np.inf
    else:
        shared = start
    _, _, known = problem.fit(shared, fields, known=True)
    whole = [y.shape[1]] * _WHOLE
    if problem.error(shared, known) <= settings.sensed_hopeless:
        error, shared, fields = problem.fit(shared, known, lengths=whole)
    else:  # what is right for the calmest rollouts is not for others
        error, shared, fields = problem.fit(shared, fields)
    return shared, np.fft.irfft(spectrum(fields, n), n), max(error - problem.noise, 0.0)


def _first_guess(
    problem: SensedProblem, settings: FieldModelSettings
) -> tuple[float, Array, Array]:
    """The least error, without that of the noise, and the unknowns of a few rollouts that have it."""
    least, best = np.inf, (np.zeros(problem.shared), problem.interpolated())
    lengths, least_begun = problem.lengths, np.inf
    for i, share in enumerate(_DISPERSIONS):
        good = least <= settings.sensed_reproduced
        if least <= settings.sensed_enough or (good and i >= _FEW):
            break
        first = np.zeros(problem.shared)
        first[TERMS.index((1, 3))] = share * settings.sensed_dispersion
        most = settings.sensed_hopeless
        problem.forget()
        begun, shared, fields = problem.fit(
            first, problem.interpolated(), lengths=lengths[:_BEGINNINGS], most=most
        )
        begun -= problem.noise
        worth = begun < (_BETTER * least_begun if good else np.inf)
        least_begun = min(least_begun, begun)
        if worth:
            error, shared, fields = problem.fit(
                shared, fields, lengths=lengths[_BEGINNINGS:], most=most
            )
            if error - problem.noise < least:
                least, best = error - problem.noise, (shared, fields)
    return least, *best


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
        settings: FieldModelSettings = DEFAULTS,
        place_ridge: float = 0.0,
        least: float = 0.0,
    ) -> None:
        self.y, self.a, self._centres, self._settings = y, a, centres, settings
        self.shared = unknowns(len(centres))
        self._size = max(float(np.sqrt(np.mean(y * y))), least) or 1.0
        self.noise: float = (noise / self._size) ** 2
        self._place_ridge = place_ridge
        near = np.pad(np.abs(y).max(axis=(0, 2)), _NEAR, mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(near, 2 * _NEAR + 1)
        self._sizes = settings.sensed_margin * windows.max(axis=1)
        self._clip = settings.sensed_clip * float(near.max())
        self._precision = np.zeros(self.shared)
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

    @property
    def lengths(self) -> list[int]:
        """Steps of the rollouts that are fitted one after the other."""
        steps, found = self.y.shape[1], []
        share = self._settings.sensed_beginning
        while share < 1.0:
            found.append(min(max(2, round(share * steps)), steps))
            share *= self._settings.sensed_continuation
        return [*found, steps]

    def fit(
        self,
        shared: Array,
        fields: Array,
        *,
        known: bool = False,
        lengths: Sequence[int] = (),
        most: float = np.inf,
    ) -> tuple[float, Array, Array]:
        """The error per reading, relative to their size, and the unknowns.

        known: the shared ones stay as they are; lengths: of the fits, `lengths` if there are none;
        most: the error after any of them, besides noise, with which the fit is given up.
        """
        lengths = lengths or self.lengths
        for steps, following in zip(lengths, [*lengths[1:], lengths[-1]], strict=True):
            moved = self._descend(shared, fields, steps, known)
            # What fits the beginning may overflow later.
            if np.isfinite(self._error(*moved, following)):
                shared, fields = moved
            if not known:
                self._precision = self._relevant(shared, fields, steps)
            if self._error(shared, fields, steps) > most + self.noise:
                return np.inf, shared, fields
        return self._error(shared, fields, lengths[-1]), shared, fields

    def forget(self) -> None:
        """Take all unknowns for relevant again."""
        self._precision = np.zeros(self.shared)

    def _relevant(self, shared: Array, fields: Array, steps: int) -> Array:
        """Ridges of the shared unknowns, s^2/(x^2 + s^2 H^-1): large where one is not significant."""
        with np.errstate(over="ignore", invalid="ignore"):
            residual, J = self._linearised(shared, fields, steps, known=False)
        if not np.isfinite(J).all():
            return self._precision
        variance = max(float(residual @ residual), self.noise) / residual.size
        inverse = np.linalg.inv(J @ J.T + np.diag(self._ridge(steps)))
        own = variance * np.diag(inverse)[: self.shared]
        found: Array = variance / np.maximum(shared**2 + own, np.finfo(float).tiny)
        return found

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
        inverse = np.linalg.inv(J @ J.T + np.diag(self._ridge(steps)[self.shared :]))
        found: Array = self._weight(steps) * np.diag(inverse)
        return found

    @property
    def suggested(self) -> Array:
        """Standard deviations of the coefficients of a field, (33,), from its size alone."""
        falling = 1.0 + (self._waves / self._settings.sensed_field_wave) ** 2
        found: Array = self._settings.sensed_field_deviation * self._size / falling
        return found

    def error(self, shared: Array, fields: Array) -> float:
        """That over whole rollouts, without what noise has in it."""
        return self._error(shared, fields, self.y.shape[1]) - self.noise

    def _error(self, shared: Array, fields: Array, steps: int) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            residuals = self._residuals(shared[None], fields[None], steps)
            error = float(np.sum(residuals**2))
        return error if np.isfinite(error) else np.inf

    def _descend(
        self, shared: Array, fields: Array, steps: int, known: bool
    ) -> tuple[Array, Array]:
        settings = self._settings
        damping = settings.sensed_damping
        begin = self.shared if known else 0
        ridge = self._ridge(steps)[begin:]
        x = np.concatenate([shared, fields.ravel()])[begin:]

        def parts(x: Array) -> tuple[Array, Array]:
            own = shared if known else x[: self.shared]
            return own, x[self.shared - begin :].reshape(fields.shape)

        def objective(x: Array) -> float:
            shared, fields = parts(x)
            residual = self._residuals(shared[None], fields[None], steps)
            total = float(np.sum(residual**2) + np.sum(ridge * x * x))
            return total if np.isfinite(total) else np.inf

        # Unknowns on the way to a good model may overflow: their error is then infinite.
        whole = steps == self.y.shape[1]
        most = settings.sensed_last_iterations if whole else settings.sensed_iterations
        with np.errstate(over="ignore", invalid="ignore"):
            now = objective(x)
            for _ in range(most):
                residual, J = self._linearised(*parts(x), steps, known)
                if not np.isfinite(J).all():
                    break
                H, g = J @ J.T, J @ residual + ridge * x
                H[np.diag_indices(x.size)] += ridge
                before = now
                while damping < _MOST_DAMPING:
                    damped = H + np.diag(damping * np.diag(H) + 1e-12)
                    moved = x - np.linalg.solve(damped, g)
                    value = objective(moved)
                    if value < now:
                        x, now = moved, value
                        damping = max(damping / 5.0, _LEAST_DAMPING)
                        break
                    damping *= 5.0
                if not now < (1.0 - settings.sensed_least_gain) * before:
                    break
        return parts(x)

    def _ridge(self, steps: int) -> Array:
        rollouts, weight, settings = len(self.y), self._weight(steps), self._settings
        shared = np.full(self.shared, weight / settings.sensed_deviation**2)
        shared[SHARED:] = weight / settings.sensed_unequal**2 + settings.sensed_unequal_ridge**2
        shared += settings.sensed_ridge**2 + self._precision
        shared[COEFFICIENTS + 1 :] += self._place_ridge**2
        rising = (1.0 + (self._waves / settings.sensed_field_wave) ** 2) ** 2 / self._size**2
        field = settings.sensed_field_ridge**2 / rollouts * rising
        if self.spread is None:
            field += weight / settings.sensed_field_deviation**2 * rising
        else:
            field += weight / self.spread**2
        return np.concatenate([shared, np.tile(field, rollouts)])

    def _weight(self, steps: int) -> float:
        """The variance of the noise on a residual."""
        rollouts, _, sensors = self.y.shape
        compared = len(range(0, steps, self._stride(steps)))
        return float(self.noise / (compared * sensors * rollouts))

    def _stride(self, steps: int) -> int:
        """Interval between compared steps, for a given number of steps."""
        return -(-steps // self._settings.sensed_compared)

    def _residuals(self, shared: Array, fields: Array, steps: int) -> Array:
        """Errors for unknowns (P, 12 + n_a) and (P, R, 33), as shares of the whole: (P, R, errors).

        Those of the readings and, over whole rollouts, that of the distance.
        """
        stride = self._stride(steps)
        equation = SensedEquation(
            *(shared[:, None], self._n, self._centres, self._settings, self._clip)
        )
        substeps = equation.substeps(self._sizes).tolist()
        z = spectrum(fields, self._n)
        residuals = []
        distance = np.zeros(z.shape[:2])
        for k in range(steps):
            if k % stride == 0:
                residuals.append((z @ self._read).real - self.y[:, k])
            distance += np.abs(z - self._target) ** 2 @ self._mean_square
            z = equation.step(z, equation.force(self.a[:, k]), substeps[k])
        whole: Array = np.concatenate(residuals, axis=2)
        whole /= self._size * np.sqrt(whole[0].size)
        if steps < self.y.shape[1]:
            return whole
        off = distance / (steps * self._distances) - 1.0
        off = np.where(np.isnan(self._distances), 0.0, off)
        off *= self._settings.sensed_distance / np.sqrt(len(self.y))
        return np.concatenate([whole, off[..., None]], axis=2)

    def _linearised(
        self, shared: Array, fields: Array, steps: int, known: bool
    ) -> tuple[Array, Array]:
        """Residuals (r,) and their derivatives (unknowns, r). A field moves its own rollout alone."""
        rollouts, own = fields.shape
        common, difference = 0 if known else self.shared, self._settings.sensed_difference
        count = 1 + common + own
        all_shared, all_fields = np.tile(shared, (count, 1)), np.tile(fields, (count, 1, 1))
        all_shared[1 : 1 + common] += difference * np.eye(self.shared)[:common]
        all_fields[1 + common :] += difference * np.eye(own)[:, None]
        residuals = self._residuals(all_shared, all_fields, steps)
        changes = (residuals[1:] - residuals[0]) / difference
        J = np.zeros((common + rollouts * own, *residuals[0].shape))
        J[:common] = changes[:common]
        for m in range(rollouts):
            J[common + m * own : common + (m + 1) * own, m] = changes[common:, m]
        return residuals[0].ravel(), J.reshape(len(J), -1)
