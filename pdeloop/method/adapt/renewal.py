# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A new law from measurements: a model of the whole field, and a descent on it.

The distance that the law moves from the first one is chosen by cross-validation on measured fields.
The fields are split into a few parts. For each part a law is computed from the other parts, and the
fractions of the way from the first law to it are compared by their costs on the model from the held-out
fields, which needs no rollouts. Among the fractions that are better than the first law by more than
chance, the cheapest is used; without evidence the first law is kept.

Costs differ far more between fields than between laws, and the saving of a law is proportional to the
cost. So the cost of the first law is the control variate: chance is that of the ratio of mean costs.

References
----------
Cochran, "Sampling Techniques", 3rd ed., Wiley 1977, chapter 6 (ratio estimators).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Record
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.adapt.estimate import ZERO, Estimate, mean_change
from pdeloop.method.adapt.improve import cheapest, curvature_of, improve
from pdeloop.method.adapt.initial_fields import measured_states, mixtures, weighted
from pdeloop.method.adapt.settings import CHAOTIC_FIELDS, CONFIRMED, FIRST_GAIN, ImprovementSettings

FRACTIONS = 4
"""Equal steps from the first law to the improved one, among which one is chosen."""
_CHAOTIC_MOST = 96
"""Measured states of a chaotic plant if the gain from fewer is not clear on the others."""
_CHAOTIC_CLEAR = 10.0
"""Multiple of the standard errors of the verdict at which such a gain is clear."""
_CHAOTIC_CONFIRMED = 0.8
"""Share of its own gain that a law must reach on other states for few to suffice."""

_Descent: TypeAlias = Callable[[Sequence[Array], Array, int], tuple[Array, int] | None]


@dataclass(frozen=True, eq=False)
class Renewal:
    """A law made on a model.

    Attributes
    ----------
    theta : (n_a, n_s + 1) array
        The law: the fraction of the way from the first one to the improved one.
    improved : (n_a, n_s + 1) array
        The law after the descent, with which the next one begins.
    parts : list of (n_a, n_s + 1) array
        The laws that each part of the fields did not make.
    fraction : float
        How far the law moved; 0: it is the first one.
    change : Estimate
        The mean change of the cost against the first law on fields that were left out. 0 where the law
        is the first one.
    steps : int
        Of L-BFGS, all together.
    """

    theta: Array
    improved: Array
    parts: list[Array]
    fraction: float
    change: Estimate
    steps: int


def renew(
    loop: ClosedLoop,
    first: Array,
    improved: Array,
    parts: Sequence[Array],
    fields: Array,
    rng: np.random.Generator,
    settings: ImprovementSettings,
    *,
    components: int = 1,
    periodic: bool = True,
    final: bool = True,
) -> Renewal | None:
    """The law of least cost on the model, moved only as far as held-out fields confirm.

    Parameters
    ----------
    loop : ClosedLoop
        The model and the cost.
    first, improved : (n_a, n_s + 1) arrays
        The law that the optimisation began with, and the one after the last descent.
    parts : sequence of (n_a, n_s + 1) array
        The same for each part of the fields; none: the first law.
    fields : (n, n_z) array
        Measured initial fields. Field i is of part i modulo the number of parts, whatever comes later,
        so that no law of a part ever sees its fields.
    rng : numpy.random.Generator
        Of the fields that are drawn.
    settings : ImprovementSettings
        Constants.
    components : int
        Number of fields in a state, stored one after the other.
    periodic : bool
        Whether they are on a ring.
    final : bool
        Whether it is the last one: others end sooner, on fewer fields that are drawn.

    Returns
    -------
    Renewal or None
        None where no law is finite on the model.
    """
    least_gain = settings.least_gain if final else FIRST_GAIN
    descend = _descent(loop, rng, settings, components, periodic, least_gain)
    few = settings.mixtures // 2
    if len(fields) == 1:  # every episode begins with this one: there is nothing to leave out
        only = descend([first, improved], fields, 0)
        if only is None:
            return None
        before, after = (float(loop.costs(theta, fields)[0]) for theta in (first, only[0]))
        return Renewal(only[0], only[0], [], 1.0, Estimate(after - before), only[1])

    def from_fields(
        start: Array, starts: Sequence[Array], drawn: int, of_parts: int
    ) -> Renewal | None:
        made, steps = _of_parts(descend, first, starts, fields, of_parts)
        best = descend([first, start], fields, drawn)
        if best is None:
            return None
        fraction, change = held_out_fraction(loop, first, made, fields, settings)
        theta = first + fraction * (best[0] - first)
        return Renewal(theta, best[0], made, fraction, change, steps + best[1])

    starts = [first] * settings.folds
    drawn, most = settings.mixtures if final else few, settings.most_mixtures
    found = from_fields(improved, parts or starts, drawn, few)
    if found is None or not final or most <= drawn:
        return found
    if not is_overfitted(loop, first, found, fields, settings):
        return found
    # A law that is best on too few fields is no start: the descent would stay near it.
    again = from_fields(first, starts, most, most)
    if again is None or not again.change.value < found.change.value:
        return found
    return replace(again, steps=found.steps + again.steps)


def is_overfitted(
    loop: ClosedLoop, first: Array, found: Renewal, fields: Array, settings: ImprovementSettings
) -> bool:
    """True if fields that were left out confirm too little of what a law gains on its own."""
    gain = _own_gain(loop, first, found, fields, settings)
    return gain > 0.0 and -found.change.value < CONFIRMED * gain


def _own_gain(
    loop: ClosedLoop, first: Array, found: Renewal, fields: Array, settings: ImprovementSettings
) -> float:
    """By how much the law after the descent is better than the first; 0 where it is hardly better."""
    before, after = loop.costs(first, fields), loop.costs(found.improved, fields)
    known = np.isfinite(before) & np.isfinite(after)
    if not known.any():
        return 0.0
    gain = float(np.sum(before[known] - after[known])) / len(fields)
    return gain if gain > FIRST_GAIN * float(before[known].mean()) else 0.0


def renew_from_states(
    loop: ClosedLoop,
    first: Array,
    improved: Array,
    records: Sequence[Record],
    rng: np.random.Generator,
    settings: ImprovementSettings,
    *,
    final: bool = True,
) -> Renewal | None:
    """As `renew`, of a chaotic plant, from measured states: more where few leave the gain in doubt.

    Costs differ so much from state to state that a law made from a few is hardly better from others.
    Where it is, the plant is only unstable, and more states would make the same law.

    records: all rollouts, denoised.
    """
    settings, found = replace(settings, mixtures=0, most_mixtures=0), None
    for count in (CHAOTIC_FIELDS, _CHAOTIC_MOST):
        fields = measured_states(records, count)
        # Others than last time, so that the laws of the parts may know those of their own part.
        found = renew(loop, first, improved, [], fields, rng, settings, final=final)
        if found is None or found.change.is_negative(settings.confidence, _CHAOTIC_CLEAR):
            break
        gain = _own_gain(loop, first, found, fields, settings)
        if gain > 0.0 and -found.change.value >= _CHAOTIC_CONFIRMED * gain:
            break
    return found


def _of_parts(
    descend: _Descent,
    first: Array,
    starts: Sequence[Array],
    fields: Array,
    drawn: int,
) -> tuple[list[Array], int]:
    """For each part of the fields the law that the others make, and all steps of L-BFGS."""
    part_of = np.arange(len(fields)) % len(starts)
    steps, made = 0, []
    for part, start in enumerate(starts):
        found = descend([first, start], fields[part_of != part], drawn)
        made.append(start if found is None else found[0])
        steps += 0 if found is None else found[1]
    return made, steps


def held_out_fraction(
    loop: ClosedLoop,
    first: Array,
    parts: Sequence[Array],
    fields: Array,
    settings: ImprovementSettings,
) -> tuple[float, Estimate]:
    """The fraction of the way from the first law, and `change` of a `Renewal`.

    parts: for each part of the fields the law that the others made.
    """
    costs = left_out_costs(loop, first, parts, fields, FRACTIONS)
    i, change = choose_fraction(costs, settings.confidence)
    return i / FRACTIONS, change


def left_out_costs(
    loop: ClosedLoop, first: Array, parts: Sequence[Array], fields: Array, fractions: int
) -> Array:
    """What each fraction of the way costs from each field that was left out, (fractions + 1, n).

    parts: for each part of the fields the law that the others made.
    """
    shares = np.linspace(0.0, 1.0, fractions + 1)
    costs = np.full((len(shares), len(fields)), np.inf)
    for part, law in enumerate(parts):
        own = np.arange(len(fields)) % len(parts) == part
        for i, share in enumerate(shares):
            costs[i, own] = loop.costs(first + share * (law - first), fields[own])
    return costs


def choose_fraction(costs: Array, confidence: float) -> tuple[int, Estimate]:
    """The row of `left_out_costs` to take, and its change against the first row."""
    # From where the first law is not finite, a law that is tells nothing of the size of a gain.
    costs = costs[:, np.isfinite(costs[0])]
    if not costs.shape[1]:
        return len(costs) - 1, ZERO
    found, least = (0, ZERO), np.inf
    for i, own in enumerate(costs[1:], 1):
        if np.isfinite(own).all() and own.mean() < least:
            change = mean_change(own, costs[0])
            if change.is_negative(confidence):
                found, least = (i, change), float(own.mean())
    return found


def _descent(
    loop: ClosedLoop,
    rng: np.random.Generator,
    settings: ImprovementSettings,
    components: int,
    periodic: bool,
    least_gain: float,
) -> _Descent:
    """The law after a descent from the cheapest of some laws, and its steps, as a function.

    Its arguments are these laws, measured fields and how many to draw.
    """
    curvature, designed = curvature_of(loop), loop.designed()
    others = [] if designed is None else [designed]

    def descend(starts: Sequence[Array], fields: Array, most: int) -> tuple[Array, int] | None:
        drawn = mixtures(fields, most, rng, components, periodic=periodic)
        every, weights = weighted(fields, drawn)
        starts = [*starts, *others]
        if loop.action_set.rated:  # actuators cannot follow the law of the linear problem
            starts = [loop.calmer(law, 0.5**i) for law in starts for i in range(6)]
        start = cheapest(loop, starts, every, weights)
        found = improve(loop, start, every, weights, curvature, settings, least_gain)
        rests = found is not None and not found.after < (1.0 - least_gain) * found.before
        if loop.action_set.bounded and found and rests:  # the gradient of saturated actions is 0
            start = loop.unsaturated(found.theta, every, weights)
            if not np.array_equal(start, found.theta):
                again = improve(loop, start, every, weights, curvature, settings, least_gain)
                found = again if again and again.after < found.after else found
        return None if found is None else (found.theta, found.steps)

    return descend
