# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The least squares problem of `pdeloop.method.models.sensed_fit`, its derivatives and its descent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models.sensed import (
    WAVES,
    Actuators,
    coefficients_of,
    grid_points,
    interpolated,
)
from pdeloop.method.models.sensed_flow import SensedFlow
from pdeloop.method.models.sensed_prior import SensedPrior
from pdeloop.method.models.sensed_unknowns import TERMS, open_unknowns, unknowns, well_posed
from pdeloop.method.models.settings import DEFAULTS, SENSED_HELD_RIDGE, FieldModelSettings

_BEGINNING = 0.05
"""Share of each rollout over which a fit begins."""
_SHORTEST = 10
"""Minimum number of its time steps."""
_CONTINUATION = 1.6
"""Factor by which the fitted share of the rollouts grows, until they are whole."""
_LEAST_GAIN = 1e-3
"""Share by which an iteration must reduce the error for the fit to continue."""
_DAMPING = 1e-2
"""Initial damping of the Levenberg-Marquardt method."""
_DIFFERENCE = 1e-5
"""Step of the finite differences."""
_DISTANCE = 0.1
"""Weight of the relative error of the distance from the target, which is known from a cost."""
_MARGIN = 1.25
"""Assumed maximum of the field, relative to the readings, that sets the internal steps."""
_CLIP = 2.0
"""Bound on z in powers during a fit, relative to the largest reading."""
_PLACE_RIDGE = 1e-3
"""Ridge of the shifts, widths and differences of actuators while no equation is known."""

# The part of rollouts that the fields of a known equation are fitted to before the whole.
_FIRST = 3
# Steps before and after one that also tell how large its field is.
_NEAR = 2
# Least and largest damping.
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e4


class SensedProblem:
    """The least squares problem: readings y (R, T, n_y), actions a (R, T, n_a), distances (R,).

    target, distances: as in `fit_sensed`; least: the least size of the readings that errors are
    relative to. noise becomes what the noise has in the mean square of the readings, as a share of it.
    """

    def __init__(
        self,
        y: Array,
        a: Array,
        actuators: Actuators,
        noise: float,
        target: Array,
        distances: Array,
        settings: FieldModelSettings = DEFAULTS,
        least: float = 0.0,
    ) -> None:
        self.y, self.a, self._actuators, self._settings = y, a, actuators, settings
        self._noise, self._aim = noise, target
        self.shared = unknowns(len(actuators.centres))
        self._open = open_unknowns(np.zeros(self.shared))
        self._size = max(float(np.sqrt(np.mean(y * y))), least) or 1.0
        self.noise: float = (noise / self._size) ** 2
        self.prior = SensedPrior(len(y), len(actuators.centres), self._size, settings)
        self.holds = bool(noise and actuators.declared)
        """True if noise would move actuators from where they are declared."""
        near = np.pad(np.abs(y).max(axis=(0, 2)), _NEAR, mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(near, 2 * _NEAR + 1)
        self._sizes = _MARGIN * windows.max(axis=1)
        self._clip = _CLIP * float(near.max())
        self.reached = 0
        """Steps of the rollouts that the last fit was over when it ended."""
        sensors = y.shape[2]
        self._n = grid_points(sensors)
        waves = np.arange(self._n // 2 + 1)
        places = (np.arange(sensors) + 0.5) / sensors
        # Of the two planes of a spectrum: the field at the sensors, and its mean square.
        twice = np.where((waves == 0) | (waves == self._n // 2), 1.0, 2.0)
        phase = 2 * np.pi * waves[:, None] * places
        self._read = np.vstack([np.cos(phase), -np.sin(phase)]) * np.tile(twice, 2)[:, None]
        self._mean_square = np.tile(twice, 2)
        aim = np.fft.rfft(interpolated(target)) / self._n
        self._target = np.concatenate([aim.real, aim.imag])
        self._distances = distances

    def interpolated(self) -> Array:
        """Initial fields from the first readings alone, (R, 33)."""
        sensors = self.y.shape[2]
        places = (np.arange(sensors) + 0.5) / sensors
        grid = np.arange(self._n) / self._n
        fields = np.stack([np.interp(grid, places, y[0], period=1.0) for y in self.y])
        return coefficients_of(fields)

    @property
    def lengths(self) -> list[int]:
        """Steps of the rollouts that are fitted one after the other."""
        steps, found = self.y.shape[1], []
        share = max(_BEGINNING, _SHORTEST / steps)
        while share < 1.0:
            found.append(min(max(2, round(share * steps)), steps))
            share *= _CONTINUATION
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
        every, self._open = self.lengths, open_unknowns(shared)
        # The fields of a known equation need less of a continuation.
        lengths = lengths or ([*every[: _FIRST + 1][-1:], every[-1]] if known else every)
        for steps, following in zip(lengths, [*lengths[1:], lengths[-1]], strict=True):
            self.reached = steps
            moved = self._descend(shared, fields, steps, known)
            # What fits the beginning may overflow later.
            if np.isfinite(self._error(*moved, following)):
                shared, fields = moved
            if not known:
                self.prior.precision = self._relevant(shared, fields, steps)
            if self._error(shared, fields, steps) > most + self.noise:
                return np.inf, shared, fields
        return self._error(shared, fields, lengths[-1]), shared, fields

    def missing(self, shared: Array, fields: Array, steps: int) -> tuple[int, float, float]:
        """The term that promises the largest fall of the error, its coefficient, and the fall.

        That of a step of Gauss and Newton in this term and all other unknowns; the fall is 0 where
        nothing is finite.
        """
        own, used = self._open, open_unknowns(shared)
        self._open = columns = np.union1d(used, np.arange(len(TERMS)))
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                residual, J = self._linearised(shared, fields, steps, known=False)
            H, g = self._normal(residual, J, steps)
            g = g + self._ridges(steps) * np.concatenate([shared[self._open], fields.ravel()])
        finally:
            self._open = own
        if not (np.isfinite(H).all() and np.isfinite(g).all()):
            return 0, 0.0, 0.0
        known = np.append(np.searchsorted(columns, used), np.arange(len(columns), len(H)))
        inverse, best = np.linalg.inv(H[np.ix_(known, known)]), (0, 0.0, 0.0)
        for i in np.setdiff1d(np.arange(len(columns)), known).tolist():
            explained = inverse @ H[known, i]
            slope, curvature = g[i] - explained @ g[known], H[i, i] - explained @ H[known, i]
            if curvature > 0.0 and slope**2 / curvature > best[2]:
                best = int(columns[i]), float(-slope / curvature), float(slope**2 / curvature)
        return best

    def _relevant(self, shared: Array, fields: Array, steps: int) -> Array:
        """Ridges of the shared unknowns, s^2/(x^2 + s^2 H^-1): large where one is not significant."""
        before = self.prior.precision
        if steps < self.y.shape[1]:
            # What a part does not determine, a longer one may.
            self.prior.forget()
        with np.errstate(over="ignore", invalid="ignore"):
            residual, J = self._linearised(shared, fields, steps, known=False)
        if not np.isfinite(J).all():
            return before
        variance = max(float(np.sum(residual**2)), self.noise) / residual.size
        inverse = np.linalg.inv(self._normal(residual, J, steps)[0])
        own = variance * np.diag(inverse)[: len(self._open)]
        found, known = np.zeros(self.shared), shared[self._open]
        found[self._open] = variance / np.maximum(known**2 + own, np.finfo(float).tiny)
        return found

    def refined(self, shared: Array, fields: Array) -> Array:
        """The fields that fit best next to these, with the shared unknowns as they are."""
        return self._descend(shared, fields, self.y.shape[1], known=True)[1]

    def variances(self, shared: Array, fields: Array) -> Array:
        """Those of the coefficients of the field of the only rollout, (33,), given its readings."""
        steps = self.y.shape[1]
        with np.errstate(over="ignore", invalid="ignore"):
            residual, J = self._linearised(shared, fields, steps, known=True)
        if not np.isfinite(J).all():
            return np.zeros(fields.shape[1])
        inverse = np.linalg.inv(self._normal(residual, J, steps)[0])
        found: Array = self.weight(steps) * np.diag(inverse)
        return found

    def error(self, shared: Array, fields: Array) -> float:
        """That over whole rollouts, without what noise has in it."""
        return self.excess(shared, fields, self.y.shape[1])

    def excess(self, shared: Array, fields: Array, steps: int) -> float:
        """The same over some steps."""
        return self._error(shared, fields, steps) - self.noise

    def part(self, rollouts: Sequence[int], *, hold: bool = False) -> SensedProblem:
        """The same for some of the rollouts; hold: with actuators near where they are declared."""
        own, settings = list(rollouts), self._settings
        part = type(self)(
            self.y[own],
            self.a[own],
            self._actuators,
            self._noise,
            self._aim,
            self._distances[own],
            settings,
        )
        if hold:
            part.prior.place_ridge = SENSED_HELD_RIDGE if self.holds else _PLACE_RIDGE
        return part

    def implausibility(self, shared: Array, fields: Array) -> float:
        """The error over whole rollouts and the ridge of the prior: least for the likeliest unknowns.

        Unlike what a fit minimises, it has the same ridges whatever that fit found to be relevant.
        """
        steps, x = self.y.shape[1], np.concatenate([shared, fields.ravel()])
        prior = self.prior.given(self._open, self.weight(steps))
        return self._error(shared, fields, steps) + float(np.sum(prior * x * x))

    def _error(self, shared: Array, fields: Array, steps: int) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            residuals = self._residuals(shared, fields[None], steps)
            error = float(np.sum(residuals**2))
        return error if np.isfinite(error) else np.inf

    def _descend(
        self, shared: Array, fields: Array, steps: int, known: bool
    ) -> tuple[Array, Array]:
        settings = self._settings
        damping = _DAMPING
        varied = self._open[:0] if known else self._open
        common = len(varied)
        ridge = self._ridges(steps)[len(self._open) - common :]
        x = np.concatenate([shared[varied], fields.ravel()])

        def parts(x: Array) -> tuple[Array, Array]:
            own = shared.copy()
            own[varied] = x[:common]
            return own, x[common:].reshape(fields.shape)

        def objective(x: Array) -> float:
            own, fields = parts(x)
            residual = self._residuals(own, fields[None], steps)
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
                H, g = self._normal(residual, J, steps)
                g += ridge * x
                before = now
                while damping < _MOST_DAMPING:
                    damped = H + np.diag(damping * np.diag(H) + 1e-12)
                    moved = x - np.linalg.solve(damped, g)
                    moved[:common] = well_posed(parts(moved)[0])[varied]
                    value = objective(moved)
                    if value < now:
                        x, now = moved, value
                        damping = max(damping / 5.0, _LEAST_DAMPING)
                        break
                    damping *= 5.0
                if not now < (1.0 - _LEAST_GAIN) * before:
                    break
        return parts(x)

    def _ridges(self, steps: int) -> Array:
        return self.prior.ridges(self._open, self.weight(steps))

    def weight(self, steps: int) -> float:
        """The variance of the noise on a residual."""
        rollouts, _, sensors = self.y.shape
        compared = len(range(0, steps, self._stride(steps)))
        return float(self.noise / (compared * sensors * rollouts))

    def _stride(self, steps: int) -> int:
        """Interval between compared steps, for a given number of steps."""
        return -(-steps // self._settings.sensed_compared)

    def _residuals(
        self, shared: Array, fields: Array, steps: int, varied: Sequence[int] = ()
    ) -> Array:
        """Errors for unknowns (44 + n_a,) and fields (P, R, 33), as shares of the whole.

        (P, R, errors): those of the readings and, over whole rollouts, that of the distance. P is
        followed by the first fields with each of the varied unknowns less by a difference.
        """
        stride, settings = self._stride(steps), self._settings
        flow = SensedFlow(
            shared,
            self._n,
            self._actuators,
            self._sizes,
            settings,
            self._clip,
            varied,
            _DIFFERENCE,
        )
        compared = len(range(0, steps, stride))
        rows, (rollouts, _, sensors) = len(fields), self.y.shape
        rows += len(varied)
        if not flow.finite:
            return np.full((rows, rollouts, compared * sensors), np.inf)
        found = np.empty((rows, rollouts, compared, sensors))
        told = steps == self.y.shape[1] and not np.isnan(self._distances).all()
        distance = np.zeros((rows, rollouts))
        for k, z in enumerate(flow.path(fields, self.a, steps)):
            z = z.reshape(rows, rollouts, -1)
            if k % stride == 0:
                found[:, :, k // stride] = z @ self._read - self.y[:, k]
            if told:
                distance += (z - self._target) ** 2 @ self._mean_square
        whole = found.reshape(rows, rollouts, -1)
        whole /= self._size * np.sqrt(whole[0].size)
        if not told:
            return whole
        off = distance / (steps * self._distances) - 1.0
        off = np.where(np.isnan(self._distances), 0.0, off)
        off *= _DISTANCE / np.sqrt(len(self.y))
        return np.concatenate([whole, off[..., None]], axis=2)

    def _linearised(
        self, shared: Array, fields: Array, steps: int, known: bool
    ) -> tuple[Array, Array]:
        """Residuals (R, errors) of the rollouts and the derivatives of each, (R, unknowns, errors).

        The unknowns are the shared ones, if they are not known, and the rollout's own field.
        """
        own, difference = fields.shape[1], _DIFFERENCE
        nearby = np.tile(fields, (1 + own, 1, 1))
        nearby[1:] -= difference * np.eye(own)[:, None]
        varied = [] if known else self._open.tolist()
        residuals = self._residuals(shared, nearby, steps, varied)
        changes = (residuals[0] - residuals[1:]) / difference
        # The shared ones first.
        return residuals[0], np.concatenate([changes[own:], changes[:own]]).swapaxes(0, 1)

    def _normal(self, residual: Array, J: Array, steps: int) -> tuple[Array, Array]:
        """Matrix and right-hand side J r of the normal equations, the matrix with its ridge.

        A field moves its own rollout alone.
        """
        own = 1 + 2 * WAVES
        common = J.shape[1] - own
        ridge = self._ridges(steps)[len(self._open) - common :]
        H, g = np.diag(ridge), np.zeros(len(ridge))
        for m, (r, part) in enumerate(zip(residual, J, strict=True)):
            rows = np.r_[:common, common + m * own : common + (m + 1) * own]
            H[np.ix_(rows, rows)] += part @ part.T
            g[rows] += part @ r
        return H, g
