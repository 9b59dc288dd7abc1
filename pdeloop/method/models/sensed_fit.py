# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The equation of `pdeloop.method.models.sensed` and initial fields from the readings of rollouts.

The initial fields of the rollouts are unknown as well: a few Fourier coefficients each. All of them are
fitted at once to the readings y_k = z_k(sensors) of whole rollouts, and to d, the mean of (z - z_r)^2
over all points and steps of each, which follows from its cost,

    min  mean over rollouts and steps |y_k^model - y_k|^2 / mean |y_k|^2
         + mean over rollouts (0.1 (d^model / d - 1))^2 + a small ridge,

by the method of Levenberg and Marquardt, first over the beginning of the rollouts and then over longer
and longer parts: over a whole rollout at once, a front makes the error flat in most unknowns. The field
between the sensors is observed later, when it passes one.

Where constant coefficients leave an error that is not noise, all rollouts are fitted once more from
nothing, with coefficients that depend on x. These count if they halve the error, and if, fitted to
every other rollout, they reproduce the rest better than constant ones that were fitted to all.

After each part the ridge of an unknown becomes s^2/(x^2 + C), with C its variance given the readings
and s^2 that of a residual. An unknown that is not significant, such as a growth that a few calm
rollouts cannot tell from none, goes to zero and does not make other rollouts run away.

References
----------
Tipping, "Sparse Bayesian learning and the relevance vector machine", J. Machine Learning Research 1,
2001 (the ridges: automatic relevance determination).
Le Dimet, Talagrand, "Variational algorithms for analysis and assimilation of meteorological
observations", Tellus A 38, 1986 (initial fields from readings: 4D-Var). Raissi, Perdikaris,
Karniadakis, "Physics-informed neural networks", J. Comput. Phys. 378, 2019 (equation and field from few
points).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models.sensed import Actuators, coefficients_of, field_of, grid_points
from pdeloop.method.models.sensed_growth import USED, Found, further_terms, grown, start_with
from pdeloop.method.models.sensed_problem import SensedProblem
from pdeloop.method.models.sensed_unknowns import EQUATION, TERMS
from pdeloop.method.models.settings import (
    DEFAULTS,
    SENSED_ALIKE_CHI,
    SENSED_ENOUGH,
    SENSED_HELD_RIDGE,
    SENSED_HOPELESS,
    SENSED_REPRODUCED,
    FieldModelSettings,
)

_LIKELIER = 30.0
"""Margin in log-likelihood by which a fit from nothing must exceed one with an earlier equation's
spread."""
_DISPERSION = 20.0
"""Dispersion at which fits start, of both signs; also half of it and 1.5 times it."""

# Shares of the declared dispersion that fits begin with: no descent leads from waves that run one way
# to waves that run the other. The last ones are tried only where none of the others is good enough.
_DISPERSIONS, _FEW = (0.0, -1.0, 1.0, -0.5, 0.5, -1.5, 1.5), 3
# Times that whole rollouts are fitted, each with the unknowns that were significant before.
_WHOLE = 2


def fit_sensed(
    readings: Sequence[Array],
    actions: Sequence[Array],
    actuators: Actuators,
    noise: float = 0.0,
    start: Array | None = None,
    target: Array | None = None,
    distances: Array | None = None,
    spread: Array | None = None,
    settings: FieldModelSettings = DEFAULTS,
    near: Array | None = None,
) -> tuple[Array, Array, float]:
    """Fit the equation and the initial fields of rollouts.

    Parameters
    ----------
    readings, actions : sequences of (T, n_y) and (T, n_a) arrays
        Of rollouts of one length: y_k and a_k.
    actuators : Actuators
        What is declared of them.
    noise : float
        Standard deviation of the noise on every reading.
    start : (44 + n_a,) array, optional
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
    near : (rollouts, n) array, optional
        Initial fields that an earlier fit of the same rollouts found with `start`.

    Returns
    -------
    (44 + n_a,) array, (rollouts, n) array and float
        The shared unknowns with the least error, the initial fields, and the error: what is minimised,
        but for the ridge and for what noise has in it. It is infinite where no equation reproduces even
        the beginning of the rollouts.
    """
    y, a = np.stack(readings), np.stack(actions)
    if target is None or distances is None:
        target, distances = np.zeros(y.shape[2]), np.full(len(y), np.nan)
    problem = SensedProblem(y, a, actuators, noise, target, distances, settings)
    problem.prior.spread = spread
    fields, n = problem.interpolated(), grid_points(y.shape[2])
    if start is not None:
        known = None if near is None else coefficients_of(near)
        found = _refined(problem, start, fields, known)
    else:
        first, *others = few_rollouts(y, a, settings.sensed_starts)
        found, enough = _from_few(problem, first, settings, np.inf), SENSED_REPRODUCED
        for few in others:
            if found[0] <= enough:
                break
            # A fit to all rollouts takes long: only from what is an equation of these few.
            own = _from_few(problem, few, settings, enough)
            found = min(found, own, key=lambda each: each[0])
        found = with_coefficients_of_x(problem, found, settings)
    error, shared, fields = found
    return shared, field_of(fields, n), max(error, 0.0)


def few_rollouts(y: Array, a: Array, most: int) -> list[list[int]]:
    """Sets of rollouts that a fit from nothing begins with, one after the other; so many at most.

    The calmest one with inputs and the calmest of the others, from which most descents find the
    equation. Where they show too little of it, the calmest one and that with the largest inputs. Then
    each of these by itself, as one rollout is reproduced more easily, and the calmest one with each of
    the others.
    """
    calmest = np.argsort(np.sum(y * y, axis=(1, 2)), kind="stable").tolist()
    acted = [m for m in calmest if a[m].any()]
    driven = np.argsort(-np.sum(a * a, axis=(1, 2)), kind="stable").tolist()
    pairs = [list(dict.fromkeys([*acted[:1], *own]))[:2] for own in (calmest, driven)]
    first = pairs[0][:1]
    alone = [first, [m for m in pairs[1] if m not in first]]
    others = [[*first, m] for m in calmest if m not in first]
    every: list[list[int]] = []
    for few in (*pairs, *alone, *others):
        if few and few not in every:
            every.append(few)
    return every[:most]


def _from_few(
    problem: SensedProblem, few: list[int], settings: FieldModelSettings, most: float
) -> Found:
    """The fit to all rollouts from what a few of them suggest, and with further terms.

    most: the error on these from which on there is none, of infinite error.
    """
    problem.prior.forget()
    fields = problem.interpolated()
    error, shared, fields[few] = _first_guess(problem.part(few, hold=True))
    if not np.isfinite(error) or error > most:
        return np.inf, shared, fields
    found = _refined(problem, shared, fields, None, first=True)
    shared = further_terms(problem, found, settings)
    if shared is not found[1]:
        found = _refined(problem, shared, problem.interpolated(), None, first=True)
    return found


def _refined(
    problem: SensedProblem,
    shared: Array,
    fields: Array,
    known: Array | None,
    *,
    first: bool = False,
) -> Found:
    """The fit to all rollouts from these unknowns; known: their fields, if an earlier fit found them.

    first: the equation is that of a few rollouts.
    """
    fresh = known is None
    if known is None:
        _, _, known = problem.fit(shared, fields, known=True)
    whole, found = [problem.y.shape[1]] * _WHOLE, []
    # Else the equation does not hold for the other rollouts: nothing is near enough for a whole fit.
    holds = problem.error(shared, known) <= SENSED_REPRODUCED
    if holds:
        found.append(problem.fit(shared, known, lengths=whole))
    # With noise two rollouts leave much of an equation open.
    if not holds or (first and problem.noise):
        problem.prior.forget()
        found.append(part_by_part(problem, shared, fields))
    if problem.noise and fresh:
        problem.prior.forget()
        most = SENSED_HOPELESS
        anew = part_by_part(problem, dispersion_of(shared), fields, most)
        found += [anew] if np.isfinite(anew[0]) else []
        # Errors that are all below the noise tell no equation from another.
        best = min(found, key=lambda own: problem.implausibility(*own[1:]))
        if problem.prior.spread is not None:
            best = far_likelier(problem, best, dispersion_of(shared), fields)
        error, shared, fields = best
    else:
        error, shared, fields = min(found, key=lambda own: own[0])
    return error - problem.noise, shared, fields


def far_likelier(problem: SensedProblem, best: Found, start: Array, fields: Array) -> Found:
    """A fit from these unknowns without a spread of waves, if it is likelier by far, or else the best.

    The spread followed from the equation before, and may hold a wrong one: with eight sensors one whose
    short waves move past them, as an advection that is not there.
    """
    spread, problem.prior.spread = problem.prior.spread, None
    problem.prior.forget()
    anew = part_by_part(problem, start, fields, SENSED_HOPELESS)
    if np.isfinite(anew[0]):
        # Each with its likeliest fields: those of the best were held to that spread.
        _, *held = problem.fit(*best[1:], known=True, lengths=[problem.y.shape[1]])
        gain = problem.implausibility(*held) - problem.implausibility(*anew[1:])
        share = problem.weight(problem.y.shape[1])  # that of one reading, with its variance
        if 0.5 * gain / share > _LIKELIER:
            best = anew
    problem.prior.spread = spread
    return best


def dispersion_of(shared: Array) -> Array:
    """No equation but the terms and the dispersion of another, on which a descent depends.

    What few rollouts suggested may be a wrong optimum, from which no descent leads away.
    """
    found, own = start_with(shared), TERMS.index((1, 3))
    found[own] = shared[own]
    return found


def part_by_part(
    problem: SensedProblem,
    shared: Array,
    fields: Array,
    most: float = np.inf,
) -> tuple[float, Array, Array]:
    """The fit over longer and longer parts; with noise, declared actuators stay where they are.

    The beginning of noisy rollouts does not determine where and how strong each of them is: what the
    equation does would be taken for that, and no descent leads back.

    most: the error after any part, besides noise, with which the fit is given up.
    """
    if not problem.holds:
        return problem.fit(shared, fields, most=most)
    problem.prior.place_ridge = SENSED_HELD_RIDGE
    error, shared, fields = problem.fit(shared, fields, most=most)
    problem.prior.place_ridge = 0.0
    problem.prior.forget()
    if not np.isfinite(error):
        return error, shared, fields
    return problem.fit(shared, fields, lengths=[problem.y.shape[1]] * _WHOLE)


def with_coefficients_of_x(
    problem: SensedProblem, first: Found, settings: FieldModelSettings
) -> Found:
    """The fit with coefficients that depend on x, if its error is less than half of the first one's.

    All of them are unknowns from the beginning: from an equation that makes up for them, as with wider
    actuators, no descent leads to the right one.
    """
    count = len(problem.y)
    if first[0] <= unexplained(problem, settings) or count < 2:
        return first
    start = np.zeros(problem.shared)
    start[len(TERMS) : EQUATION] = USED
    some, others = (problem.part(range(own, count, 2)) for own in (0, 1))
    most = SENSED_HOPELESS
    error, shared, _ = part_by_part(some, start, some.interpolated(), most)
    if not np.isfinite(error):
        return first
    before = foretold(others, first[1], np.inf) if np.isfinite(first[0]) else np.inf
    # These rollouts are among those that the first equation was fitted to.
    if not foretold(others, shared, most) < min(before, SENSED_REPRODUCED):
        return first
    problem.prior.forget()
    found = _refined(problem, shared, problem.interpolated(), None)
    reproduced = found[0] <= SENSED_REPRODUCED
    return found if reproduced and halved(first[0], found[0], settings) else first


def foretold(problem: SensedProblem, shared: Array, most: float) -> float:
    """The error of this equation in these rollouts, from their likeliest fields.

    most: as for `SensedProblem.fit`.
    """
    return problem.fit(shared, problem.interpolated(), known=True, most=most)[0] - problem.noise


def unexplained(problem: SensedProblem, settings: FieldModelSettings) -> float:
    """The least error that is due neither to the grid nor to chance in the noise."""
    chance = SENSED_ALIKE_CHI * problem.noise * np.sqrt(2.0 / problem.y.size)
    return max(settings.sensed_varying, float(chance))


def halved(before: float, after: float, settings: FieldModelSettings) -> bool:
    """True if an error is less than half of another, beside what the grid does not resolve."""
    unresolved = settings.sensed_unresolved**2
    return after + unresolved < 0.5 * (before + unresolved)


def _first_guess(problem: SensedProblem) -> Found:
    """The least error, and the unknowns of a few rollouts that have it."""
    best = np.inf, np.zeros(problem.shared), problem.interpolated()
    reached, longest = 0, best
    for i, share in enumerate(_DISPERSIONS):
        good = best[0] <= SENSED_REPRODUCED
        if best[0] <= SENSED_ENOUGH or (good and i >= _FEW):
            break
        start = np.zeros(problem.shared)
        start[TERMS.index((1, 3))] = share * _DISPERSION
        problem.prior.forget()
        most = SENSED_HOPELESS
        error, *found = problem.fit(start, problem.interpolated(), most=most)
        if error - problem.noise < best[0]:
            best = error - problem.noise, found[0], found[1]
        if problem.reached > reached:
            reached, longest = problem.reached, (np.inf, found[0], found[1])
    if np.isfinite(best[0]) or not reached:
        return best
    return grown(problem, longest, problem.missing(*longest[1:], reached), reached)
