# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The equation of `pdeloop.method.models.sensed` and initial fields from the readings of rollouts.

With z_{k+1} = f(z_k, a_k; phi) the equation over a sampling time and H the sensors, the likeliest phi
and initial fields minimise

    J = sum_r sum_{k < m} |y_k - H z_k|^2 / (2 sigma^2) + |phi / s|^2 / 2 + sum_r |z_0 / S|^2 / 2

over the first m steps of the rollouts r, and for whole rollouts also the error of d, the mean of
(z - z_r)^2 over all points and steps, which follows from the cost of a rollout. z_0 has 33 Fourier
coefficients with the standard deviations S.

m grows from a twentieth of the rollouts to all of their steps: over a whole rollout at once, a front
makes J flat in most unknowns. Each is the method of Levenberg and Marquardt. As z_0 moves its own
rollout alone, it is eliminated,

    A_r = J_z^T J_z + S^-2,  B_r = J_z^T J_phi,
    (sum_r J_phi^T J_phi + s^-2 - sum_r B_r^T A_r^-1 B_r) dphi = g_phi - sum_r B_r^T A_r^-1 g_z.

Whole rollouts are fitted again with the S that the last fit implies (empirical Bayes), without terms
whose loss of J is small. Derivatives are finite differences: all equations that share their terms are
one batch of the compiled solver, as what an action does is linear in the supports and their strengths.
Where no equation reproduces whole rollouts, one in which long waves grow and short ones decay is fitted
to pieces of them, as of a chaotic plant.

References
----------
Le Dimet, Talagrand, Tellus A 38, 1986 (initial fields from readings: 4D-Var). Bock, "Recent advances in
parameter identification techniques for ODE", 1983 (elimination of initial states). MacKay, "Bayesian
interpolation", Neural Computation 4(3), 1992 (the deviations).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import DEFAULTS, FieldModelSettings
from pdeloop.method.models.sensed import (
    COEFFICIENTS,
    EQUATION,
    FIRST,
    SHARED,
    TERMS,
    WAVES,
    Actuators,
    SensedEquation,
    SensedModel,
    coefficients_of,
    field_of,
    grid_points,
    interpolated,
    unit,
    unknowns,
    well_posed,
)
from pdeloop.solver.polynomial_step import PolynomialStep, PolynomialSteps

SENSED_REPRODUCED = 0.05
"""Maximum error of an equation that is used."""
# A rate per sampling time beyond which no coefficient of a step can be computed.
_FASTEST = 1e50


class SensedFlow:
    """The equation with unknowns `shared` (44 + n_a,), and with the varied ones less by a difference.

    sizes (T,): how large the fields on n points are at the time steps, which the internal steps follow;
    clip: as for `SensedEquation.compiled`; varied: which unknowns, in their order.
    """

    def __init__(
        self,
        shared: Array,
        n: int,
        actuators: Actuators,
        sizes: Array,
        settings: FieldModelSettings,
        clip: float,
        varied: Sequence[int] = (),
        difference: float = 0.0,
    ) -> None:
        changes = np.zeros((1 + len(varied), shared.size))
        changes[1 + np.arange(len(varied)), list(varied)] = difference
        equations = [SensedEquation(shared - own, n, actuators, settings) for own in changes]
        first, self._terms = (
            equations[0],
            [own for i, own in zip(varied, equations[1:], strict=True) if i < EQUATION],
        )
        self.finite = all(
            bool(np.abs(each.symbols[0]).max() < _FASTEST) for each in [first, *self._terms]
        )
        """False where the unknowns are so far off that nothing can be simulated."""
        self._modes, self._clip, self._first = n // 2 + 1, clip, first
        self._substeps = _few(first.substeps(sizes)) if self.finite else np.ones(0, np.int64)
        # Shift, spacing and width of the actuators change the supports; the others only strengths.
        moved = [k for k, i in enumerate(varied, start=1) if COEFFICIENTS < i < SHARED]
        self._supports = np.hstack([equations[i].supports for i in (0, *moved)])
        n_a, self._blocks = len(actuators.centres), 1 + len(moved)
        self._gains = np.zeros((len(equations), self._blocks * n_a + 1))
        for i, equation in enumerate(equations):
            block = 1 + moved.index(i) if i in moved else 0
            self._gains[i, block * n_a : (block + 1) * n_a] = equation.strengths
            self._gains[i, -1] = equation.constant
        self._made: dict[int, tuple[PolynomialStep, PolynomialSteps | None]] = {}

    def path(self, fields: Array, actions: Array, steps: int) -> Iterator[Array]:
        """The spectra (F + unknowns, R, 2, modes), step by step, in one array that changes.

        fields (F, R, 33): initial ones, the first also with other unknowns; actions (R, T, n_a).
        """
        count = len(fields)
        start = np.concatenate([fields, np.repeat(fields[:1], len(self._gains) - 1, axis=0)])
        z = np.zeros((*start.shape[:2], 2, self._modes))
        z[:, :, 0, : WAVES + 1] = start[..., : WAVES + 1]
        z[:, :, 1, 1 : WAVES + 1] = start[..., WAVES + 1 :]
        gains = np.concatenate([np.repeat(self._gains[:1], count, axis=0), self._gains[1:]])
        acted = np.concatenate(
            [np.tile(actions, self._blocks), np.ones((*actions.shape[:2], 1))], axis=2
        )
        with_terms = slice(count, count + len(self._terms))
        alike = slice(count), slice(with_terms.stop, len(z))
        for k in range(steps):
            yield z
            inputs = gains[:, None] * acted[None, :, k]
            step, others = self._steps(int(self._substeps[k]))
            for rows in alike:
                step.advance(_rows(z[rows]), _rows(inputs[rows]))
            if others is not None:
                others.advance(_rows(z[with_terms]), _rows(inputs[with_terms]))

    def _steps(self, substeps: int) -> tuple[PolynomialStep, PolynomialSteps | None]:
        """Of the equation, and of those with other terms."""
        if substeps not in self._made:
            first, *others = (
                equation.compiled(substeps, self._supports, self._clip)
                for equation in (self._first, *self._terms)
            )
            self._made[substeps] = first, PolynomialSteps(others) if others else None
        return self._made[substeps]


def _rows(batch: Array) -> Array:
    """As one batch: (a, b, ...) to (a b, ...)."""
    return batch.reshape(-1, *batch.shape[2:])


def _few(substeps: NDArray[np.int64]) -> NDArray[np.int64]:
    """At least as many, of few different numbers: each is half as much again as the one before."""
    levels = [1]
    while levels[-1] < substeps.max():
        levels.append(levels[-1] + max(levels[-1] // 2, 1))
    found: NDArray[np.int64] = np.array(levels)[np.searchsorted(levels, substeps)]
    return found


_FEW = tuple(range(len(FIRST)))
_LIBRARIES: tuple[tuple[tuple[int, ...], bool, float], ...] = (
    (_FEW, False, 0.0),
    (_FEW, True, 0.0),
    ((*_FEW, TERMS.index((1, 4)), TERMS.index((3, 2))), False, 0.0),
    ((*_FEW, TERMS.index((4, 0)), TERMS.index((5, 0))), False, 0.0),
    ((*_FEW, *range(len(TERMS), EQUATION)), False, 3e-4),
)
"""Unknowns of the equations that are fitted one after the other; whether actuators differ in strength
(few sensors tell little of it, and waves that they do not resolve would be taken for differences); and
the error from which each is tried, beside what neither the grid nor chance explains."""
_INSTABILITY = TERMS.index((1, 2)), TERMS.index((1, 4))
"""z_xx and z_xxxx: with coefficients below 0 long waves grow and short ones decay."""
_PIECES, _GROWTH = 4, 0.1
"""Pieces of a rollout, and how much their strongest wave grows in a sampling time to begin with."""
_BEGINNING, _SHORTEST, _LONGER = 0.05, 10, 1.5
"""Share of each rollout over which a fit begins, its least number of steps, and its growth."""
_EARLY = 4
"""Which of these parts the field of a known equation is fitted to before the whole."""
_COMPARED = 100
"""Maximum number of time steps whose readings are compared."""
_ITERATIONS, _LAST_ITERATIONS = 20, 40
"""Of a part, and of whole rollouts, at most."""
_LEAST_GAIN = 1e-3
"""Share of J that an iteration must gain for the fit to continue."""
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-8, 1e6
_DIFFERENCE = 1e-5
"""Step of the finite differences."""
_DEVIATION, _UNEQUAL, _WIDTH = 30.0, 3.0, 0.3
"""Prior standard deviations of a coefficient, of an actuator's strength from the mean one, and of a
width that is not declared."""
_WAVE = 2.0
"""Wavenumber beyond which the prior deviation of a field's coefficients falls."""
_DISTANCE = 0.01
"""Standard deviation of d, relative to it."""
_EXACT = 1e-4
"""Least sigma, relative to the readings."""
_LOST = 0.25
"""Error, in variances of a reading, from which a fit tells nothing of the plant."""
_STARTS = ((0.3, 0.0), (1.0, 0.0), (0.0, -20.0), (0.0, 20.0))
"""Of fits from nothing: the least sigma, relative to the readings, until whole rollouts were fitted, as
short parts would be taken too literally; and the coefficient of the third derivative, as no descent
leads from waves that run one way to waves that run the other."""
_HOPELESS = 0.1
"""Error over any part of the rollouts at which a fit is abandoned."""
_TOLD, _ENOUGH, _BEHIND = 0.25, 30, 0.8
"""Share of the steps, and their number, from which a fit is abandoned whose error is not so much below
another one's."""
_CHANCE = 4.0
"""Error, in standard deviations of the noise in it, that chance explains."""
_TERM = 4.0
"""Loss of J for which a term stays."""
_AGAIN = 2
"""Times that whole rollouts are fitted again."""
_SETTLED = 0.05
"""Relative change of S below which they are not."""
_MARGIN, _NEAR, _CLIP = 1.3, 2, 3.0
"""The size of a field relative to the largest reading of as many steps before and after, which sets the
internal steps, and the bound on z in powers."""
_WAVENUMBERS = np.r_[0, 1 : WAVES + 1, 1 : WAVES + 1]


@dataclass(frozen=True, eq=False)
class Fitted:
    """An equation with unknowns `shared` (44 + n_a,), the initial fields (rollouts, n), and S (33,).

    error: squared error of the readings over their sum of squares, less the noise's share; noise:
    standard deviation of what is not predicted of a reading.
    """

    shared: Array
    fields: Array
    spread: Array
    error: float
    noise: float


def fit_sensed(
    readings: Sequence[Array],
    actions: Sequence[Array],
    places: Array,
    actuators: Actuators,
    noise: float = 0.0,
    start: tuple[Array, Array] | None = None,
    target: Array | None = None,
    distances: Array | None = None,
    settings: FieldModelSettings = DEFAULTS,
) -> Fitted:
    """Fit the equation and the initial fields of rollouts of one length.

    readings (T, n_y), actions (T, n_a): y_k and a_k of each; places (n_y,): of the sensors; noise:
    standard deviation of that on every reading; start: unknowns (44 + n_a,) of an earlier equation and
    its S (33,), to begin with in place of none; target (n_y,): z_r at the sensors; distances
    (rollouts,): d of each, NaN where it is not known.
    """
    data = _Data(
        np.stack(readings), np.stack(actions), places, actuators, noise, target, distances, settings
    )
    if start is not None and (fit := _continued(data, *start)).reproduces:
        return fit.found
    first, best = _of_first_terms(data)
    for library, unequal, least in _LIBRARIES[1:]:
        error = best.error(data.steps)
        if error <= max(least, data.unexplained):
            continue
        most = 0.5 * (error + data.unresolved) - data.unresolved
        if best.lost or best.promised(library, unequal) < most:
            fit = _Fit(data, library, unequal).fitted(first)
            if fit.error(data.steps) < most:
                best = fit
    return (best if best.reproduces else _of_pieces(data)).found


def _continued(data: _Data, shared: Array, spread: Array) -> _Fit:
    """A fit of the terms of an equation that begins with it."""
    own = np.flatnonzero(shared[:EQUATION]).tolist()
    fit = _Fit(data, own, bool(shared[SHARED:].any()), shared, spread)
    if _INSTABILITY[1] in own:  # rates that nearly cancel are larger than those of other equations
        fit.deviations = np.maximum(fit.deviations, np.abs(shared[fit.varied]))
    return fit.fitted()


def _of_pieces(data: _Data) -> _Fit:
    """Of pieces of the rollouts, and then of all if it reproduces these.

    Readings of a chaotic plant soon tell nothing of the initial field. Its long waves grow and its
    short ones decay, to which no descent leads from waves of which none grows.
    """
    pieces = data.pieces
    fit = _Fit(pieces, (*_FEW, _INSTABILITY[1]), False)
    fit.shared[[*_INSTABILITY]] = pieces.instability
    if not fit.fitted().reproduces:
        return fit
    whole = _continued(data, fit.shared, fit.spread)
    return whole if whole.reproduces else fit


def _of_first_terms(data: _Data) -> tuple[_Fit, _Fit]:
    """Of fits from nothing, until one is not lost: the first, if not abandoned, and the best."""
    fits = list[_Fit]()
    for loose, dispersion in _STARTS:
        fit = _Fit(data, *_LIBRARIES[0][:2], loose=loose)
        fit.shared[TERMS.index((1, 3))] = dispersion
        fits.append(fit.fitted(fits[0] if fits else None))
        if not fit.lost:
            return fit, fit
    best = min(fits, key=lambda fit: fit.error(data.steps))
    return fits[0] if data.steps in fits[0].errors else best, best


def initial_field(
    model: SensedModel,
    readings: Array,
    actions: Array,
    target: Array,
    distance: float,
    settings: FieldModelSettings = DEFAULTS,
) -> tuple[Array, float]:
    """The likeliest initial field (n,) of a rollout on a model, and its error as in `Fitted`.

    target, distance: z_r at the sensors (n_y,), and d, NaN where it is not known.
    """
    y, a, d = readings[None], actions[None], np.array([distance])
    exact = replace(settings, sensed_unresolved=0.0)  # the model's noise has that in it
    data = _Data(y, a, model.places, model.actuators, model.noise, target, d, exact)
    fit = _Fit(data, (), False, model.shared, model.spread, known=True)
    for m in (data.lengths[:_EARLY][-1], data.steps):
        fit.descend(m)
    field: Array = field_of(fit.fields, data.n)[0]
    return field, fit.error(data.steps)


class _Data:
    """Rollouts: y (R, T, n_y), a (R, T, n_a), and how their errors are measured."""

    def __init__(
        self,
        y: Array,
        a: Array,
        places: Array,
        actuators: Actuators,
        noise: float,
        target: Array | None,
        distances: Array | None,
        settings: FieldModelSettings,
    ) -> None:
        self.readings, self.actions, self.actuators, self.settings = y, a, actuators, settings
        self.places = places
        self.rollouts, self.steps, sensors = y.shape
        # Readings that a law brings to the target say little of the size of the field before.
        self.size = float(np.sqrt(max(np.mean(y * y), np.mean(y[:, 0] ** 2)))) or 1.0
        self.noise = noise
        # Else what the grid does not resolve would be taken for fields and actuators.
        self.unresolved = max(settings.sensed_unresolved, _EXACT) ** 2
        self.sigma = float(np.sqrt(noise**2 + self.unresolved * self.size**2))
        self.n = grid_points(sensors)
        near = np.pad(np.abs(y).max(axis=(0, 2)), _NEAR, mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(near, 2 * _NEAR + 1)
        self.sizes, self.clip = _MARGIN * windows.max(axis=1), _CLIP * float(near.max())
        waves = np.arange(self.n // 2 + 1)
        # Of the two planes of a spectrum: the field at the sensors, and its mean square.
        self.mean_square = np.tile(np.where((waves == 0) | (waves == self.n // 2), 1.0, 2.0), 2)
        phase = 2 * np.pi * waves[:, None] * places
        self.read = np.vstack([np.cos(phase), -np.sin(phase)]) * self.mean_square[:, None]
        given = np.zeros(sensors) if target is None else target
        aim = np.fft.rfft(interpolated(given, places)) / self.n
        self.target = np.concatenate([aim.real, aim.imag])
        self.distances = np.full(len(y), np.nan)
        if target is not None and distances is not None:
            self.distances = distances
        grid = np.arange(self.n) / self.n
        first = np.stack([np.interp(grid, places, own[0], period=1.0) for own in y])
        self.interpolated = coefficients_of(first)

    @property
    def pieces(self) -> _Data:
        """The rollouts in pieces of equal lengths."""
        m = max(self.steps // _PIECES, 1)
        y, a = (
            np.concatenate([own[:, k : k + m] for k in range(0, self.steps - m + 1, m)])
            for own in (self.readings, self.actions)
        )
        return _Data(y, a, self.places, self.actuators, self.noise, None, None, self.settings)

    @property
    def instability(self) -> Array:
        """Coefficients of these terms with which the strongest wave of the readings grows most."""
        power = np.mean(np.abs(np.fft.rfft(self.readings)) ** 2, axis=(0, 1))
        k = 2.0 * np.pi * (1 + int(np.argmax(power[1:])) if len(power) > 1 else 1)
        second, fourth = (unit(*TERMS[i]) for i in _INSTABILITY)
        return -_GROWTH * np.array([2.0 / (second * k**2), 1.0 / (fourth * k**4)])

    @property
    def lengths(self) -> list[int]:
        """Steps of the rollouts that are fitted one after the other."""
        found, m = list[int](), max(_SHORTEST, round(_BEGINNING * self.steps))
        while m < self.steps:
            found.append(m)
            m = int(np.ceil(_LONGER * m))
        return [*found, self.steps]

    @property
    def unexplained(self) -> float:
        """The least error that is due neither to the grid nor to chance in the noise."""
        share = (self.noise / self.size) ** 2
        return self.unresolved + _CHANCE * share * float(np.sqrt(2.0 / self.readings.size))


class _Fit:
    """The unknowns of a fit, and its descent.

    library: the coefficients that are not known; unequal: whether actuators differ in strength; spread:
    S, if it is known. `known` leaves nothing but the fields.
    """

    def __init__(
        self,
        data: _Data,
        library: Sequence[int],
        unequal: bool,
        shared: Array | None = None,
        spread: Array | None = None,
        *,
        loose: float = _STARTS[0][0],
        known: bool = False,
    ) -> None:
        self.data, self.fields, size = data, data.interpolated, data.size
        self.errors = dict[int, float]()
        """Over the parts that it was fitted to."""
        count = unknowns(data.actions.shape[2])
        self.shared = np.zeros(count) if shared is None else shared.copy()
        self.sigma = data.sigma if known else max(data.sigma, loose * size)
        self.spread = size / (1.0 + (_WAVENUMBERS / _WAVE) ** 2) if spread is None else spread
        width = [] if data.actuators.declared else [COEFFICIENTS + 3]
        each = range(SHARED, count) if unequal else ()
        varied = [*library, COEFFICIENTS - 1, COEFFICIENTS, *width, *each]
        self.varied: NDArray[np.intp] = np.array([] if known else varied, dtype=np.intp)
        self.deviations = np.full(len(self.varied), _DEVIATION)
        for i, own in enumerate(self.varied.tolist()):
            if own < len(TERMS):
                self.deviations[i] /= size ** (TERMS[own][0] - 1)
            elif own == COEFFICIENTS - 1:
                self.deviations[i] *= size
            elif own == COEFFICIENTS + 3:
                self.deviations[i] = _WIDTH
            elif own >= SHARED:
                self.deviations[i] = _UNEQUAL

    def fitted(self, other: _Fit | None = None) -> _Fit:
        """This one, over longer and longer parts, as long as it is better there than another one."""
        data = self.data
        for m in data.lengths:
            self.descend(m)
            self.errors[m], most = self.error(m), _HOPELESS
            if other is not None and m >= max(_TOLD * data.steps, _ENOUGH):
                most = min(most, _BEHIND * other.errors.get(m, np.inf))
            if self.errors[m] > most:
                return self
        self.sigma = data.sigma
        self.descend(data.steps)
        for _ in range(_AGAIN):
            before = self.spread
            if not self.learn():
                break
            self.descend(data.steps)
            if np.linalg.norm(self.spread - before) <= _SETTLED * np.linalg.norm(before):
                break
        return self

    @property
    def reproduces(self) -> bool:
        """True if it may be used."""
        return self.error(self.data.steps) <= SENSED_REPRODUCED

    @property
    def lost(self) -> bool:
        """True if it is so far off that it tells nothing of the plant, so that others are tried."""
        data = self.data
        least = max(_LOST * (data.sigma / data.size) ** 2, data.unexplained)
        return self.error(data.steps) > min(least, SENSED_REPRODUCED)

    @property
    def found(self) -> Fitted:
        """What it found."""
        data, error = self.data, self.error(self.data.steps)
        noise = float(np.hypot(data.sigma, np.sqrt(error) * data.size))
        return Fitted(self.shared, field_of(self.fields, data.n), self.spread, error, noise)

    def promised(self, library: Sequence[int], unequal: bool) -> float:
        """The error that one step with these unknowns promises, by its curvature."""
        data = self.data
        other = _Fit(data, library, unequal, self.shared, self.spread)
        other.fields, other.sigma = self.fields, self.sigma
        with np.errstate(all="ignore"):
            known = other._expansion(data.steps)
        if known is None:
            return 0.0
        H, rest, X = eliminated(*known)
        gz = known[3]
        gain = 0.5 * float(rest @ np.linalg.solve(H, rest) + np.sum(gz * X[..., -1]))
        share = 2.0 * gain / data.readings.size * (self.sigma / data.size) ** 2
        return self.error(data.steps) - share

    def error(self, m: int) -> float:
        """Mean square of the errors of the first m readings, less the noise, relative to their size."""
        data = self.data
        with np.errstate(all="ignore"):
            e = self._errors(self.shared, self.fields[None], m)[0]
            readings = e[:, : e.shape[1] - bool(self._told(m))]
            found = float(np.mean(readings**2)) / -(-m // _COMPARED) * self.sigma**2
        return max(found - data.noise**2, 0.0) / data.size**2 if np.isfinite(found) else np.inf

    def descend(self, m: int) -> None:
        """Iterate over the first m steps."""
        damping = _DAMPING
        most = _LAST_ITERATIONS if m == self.data.steps else _ITERATIONS
        with np.errstate(all="ignore"):
            now = self._value(self.shared, self.fields, m)
            for _ in range(most):
                known = self._expansion(m)
                if known is None:
                    return
                A, B, C, gz, gp = known
                before = now
                while damping < _MOST_DAMPING:
                    damped = A + damping * np.einsum("ruu,uv->ruv", A, np.eye(A.shape[1]))
                    H, rest, X = eliminated(damped, B, C + damping * np.diag(np.diag(C)), gz, gp)
                    shared = self._moved(H, rest)
                    dp = (self.shared - shared)[self.varied]
                    fields = self.fields - (X[..., -1] - X[..., :-1] @ dp)
                    value = self._value(shared, fields, m)
                    if value < now:
                        self.shared, self.fields, now = shared, fields, value
                        damping = max(damping / 5.0, _LEAST_DAMPING)
                        break
                    damping *= 5.0
                if not now < before - _LEAST_GAIN * max(before, 1.0):
                    return

    def _moved(self, H: Array, g: Array) -> Array:
        """The shared unknowns after a step; those that a bound stops stay, the others do without."""
        shared, free = self.shared.copy(), np.ones(len(g), dtype=bool)
        for _ in range(4):
            dp = np.zeros(len(g))
            dp[free] = np.linalg.solve(H[np.ix_(free, free)], g[free])
            shared[self.varied] = self.shared[self.varied] - dp
            bounded = well_posed(shared)
            stopped = free & (self.shared[self.varied] == 0.0) & (dp != 0.0)
            stopped &= bounded[self.varied] == 0.0
            if not stopped.any():
                break
            free &= ~stopped
        return bounded

    def learn(self) -> bool:
        """S from what was found, and fewer terms; False where nothing is finite."""
        with np.errstate(all="ignore"):
            known = self._expansion(self.data.steps)
        if known is None:
            return False
        P = eliminated(*known)[0]
        own = np.diagonal(np.linalg.inv(known[0]), axis1=1, axis2=2)
        second = np.sum(self.fields**2 + own, axis=0)
        # Nothing is known of where on the circle a field is.
        second[1:] = np.tile(second[1:].reshape(2, WAVES).mean(axis=0), 2)
        self.spread = np.sqrt((second + self.spread**2) / (self.data.rollouts + 1))
        self._leave_out(P)
        return True

    def _leave_out(self, P: Array) -> None:
        """Leave out the terms whose loss of J, by its curvature P, is small, one by one."""
        kept, shared = list(range(len(self.varied))), self.shared[self.varied]
        while True:
            V = np.linalg.inv(P[np.ix_(kept, kept)])
            losses = {
                i: 0.5 * shared[i] ** 2 / V[j, j]
                for j, i in enumerate(kept)
                if self.varied[i] < EQUATION
            }
            least = min(losses, key=losses.__getitem__, default=None)
            if least is None or losses[least] > _TERM:
                break
            j = kept.index(least)
            shared[kept] -= V[:, j] * shared[least] / V[j, j]
            shared[least] = 0.0
            kept.pop(j)
        self.shared[self.varied] = shared
        self.shared = well_posed(self.shared)
        self.varied, self.deviations = self.varied[kept], self.deviations[kept]

    def _expansion(self, m: int) -> tuple[Array, Array, Array, Array, Array] | None:
        """Curvatures A (R, 33, 33), B (R, 33, varied), that of phi, and slopes of J, or None."""
        e, Jz, Jp = self._derivatives(m)
        if not (np.isfinite(Jz).all() and np.isfinite(Jp).all()):
            return None
        A = np.einsum("ure,vre->ruv", Jz, Jz) + np.diag(self.spread**-2.0)
        B = np.einsum("ure,vre->ruv", Jz, Jp)
        C = np.einsum("ure,vre->uv", Jp, Jp) + np.diag(self.deviations**-2.0)
        gz = np.einsum("ure,re->ru", Jz, e) + self.fields / self.spread**2
        gp = np.einsum("ure,re->u", Jp, e) + self.shared[self.varied] / self.deviations**2
        return A, B, C, gz, gp

    def _value(self, shared: Array, fields: Array, m: int) -> float:
        """J."""
        e = self._errors(shared, fields[None], m)
        prior = np.sum((shared[self.varied] / self.deviations) ** 2)
        found = 0.5 * float(np.sum(e * e) + prior + np.sum((fields / self.spread) ** 2))
        return found if np.isfinite(found) else np.inf

    def _derivatives(self, m: int) -> tuple[Array, Array, Array]:
        """Errors (R, errors), and their derivatives by fields and shared unknowns, (., R, errors)."""
        own = self.fields.shape[1]
        nearby = np.tile(self.fields, (1 + own, 1, 1))
        nearby[1:] -= _DIFFERENCE * np.eye(own)[:, None]
        e = self._errors(self.shared, nearby, m, self.varied.tolist())
        J = (e[:1] - e[1:]) / _DIFFERENCE
        return e[0], J[:own], J[own:]

    def _told(self, m: int) -> bool:
        return m == self.data.steps and not np.isnan(self.data.distances).all()

    def _errors(self, shared: Array, fields: Array, m: int, varied: Sequence[int] = ()) -> Array:
        """Errors (P, R, errors) of the first m readings and of d, in standard deviations.

        P: of the fields, then of the first of them with each of the varied unknowns less by a
        difference.
        """
        data, stride, told = self.data, -(-m // _COMPARED), self._told(m)
        flow = SensedFlow(
            shared,
            data.n,
            data.actuators,
            data.sizes,
            data.settings,
            data.clip,
            varied,
            _DIFFERENCE,
        )
        rows = len(fields) + len(varied)
        if not flow.finite:
            return np.full((rows, data.rollouts, 1), np.inf)
        found, distance = [], np.zeros((rows, data.rollouts))
        for k, z in enumerate(flow.path(fields, data.actions, m)):
            z = z.reshape(rows, data.rollouts, -1)
            if k % stride == 0:
                found.append(z @ data.read - data.readings[:, k])
            if told:
                distance += (z - data.target) ** 2 @ data.mean_square
        e = np.stack(found, axis=2).reshape(rows, data.rollouts, -1)
        e *= np.sqrt(stride) / self.sigma
        if not told:
            return e
        off = (distance / (m * data.distances) - 1.0) / _DISTANCE
        return np.concatenate([e, np.where(np.isnan(off), 0.0, off)[..., None]], axis=2)


def eliminated(A: Array, B: Array, C: Array, gz: Array, gp: Array) -> tuple[Array, Array, Array]:
    """Curvature and slope of J by phi alone, and A^-1 [B, g_z] of each rollout (R, 33, varied + 1)."""
    X = np.linalg.solve(A, np.concatenate([B, gz[:, :, None]], axis=2))
    H = C - np.einsum("ruv,ruw->vw", B, X[..., :-1])
    return H, gp - np.einsum("ruv,ru->v", B, X[..., -1]), X
