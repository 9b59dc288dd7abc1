# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer on a model of the field between few sensors.

The initial field of a rollout is estimated from its readings
(`pdeloop.method.models.sensed_smoothing`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Context, Record
from pdeloop.method.adapt.closed_loop import ClosedLoopProblem, Simulation
from pdeloop.method.adapt.estimated_loop import simulate_estimated
from pdeloop.method.adapt.observed_loop import ObservedLoop
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.observer import Observer
from pdeloop.method.models.sensed import Actuators, SensedModel, interpolated, sensed_model
from pdeloop.method.models.sensed_fit import fit_sensed, halved
from pdeloop.method.models.sensed_smoothing import Smoothing, settled
from pdeloop.method.models.settings import (
    DEFAULTS,
    SENSED_ALIKE_CHI,
    SENSED_MOST,
    SENSED_REPRODUCED,
    FieldModelSettings,
)

_LARGEST_COST = 3.0
"""Maximum cost of a rollout in a fit, per cost of the exploration."""
_EXTRAPOLATION = 1.5
"""Maximum of simulated fields, relative to the estimated initial ones."""

_SMOOTHED: WeakKeyDictionary[SensedModel, WeakKeyDictionary[Record, tuple[Array, float]]] = (
    WeakKeyDictionary()
)
"""Initial fields that were found with a model: functions of both alone."""


@dataclass(frozen=True, eq=False)
class SensedLoop(ObservedLoop):
    """Laws with an observer on a `SensedModel`; U and target are those of its grid."""

    settings: FieldModelSettings = DEFAULTS

    def theta(self, policy: Array) -> Array:
        """Theta, or the whole vector of a law whose actions depend on an estimate of the field."""
        if isinstance(self.law, ExtendedKalman) and self.law.estimates(policy):
            return np.ravel(policy).copy()
        return super().theta(policy)

    def policy(self, theta: Array, near: Array) -> Array:
        return theta.reshape(near.shape).copy() if theta.ndim == 1 else super().policy(theta, near)

    def simulate(self, theta: Array, fields: Array) -> Simulation:
        if theta.ndim > 1:
            return super().simulate(theta, fields)
        assert isinstance(self.law, ExtendedKalman)
        return simulate_estimated(self, self.law, theta, fields)

    def beginnings(self, records: Sequence[Record]) -> Array:
        """The initial field of each rollout, as its readings tell it."""
        return np.stack([self.smoothed(record)[0] for record in records])

    def smoothed(self, record: Record) -> tuple[Array, float]:
        """The initial field of a rollout, and its error."""
        model = self.model
        assert isinstance(model, SensedModel)
        known = _SMOOTHED.setdefault(model, WeakKeyDictionary())
        if record not in known:  # each renewal and the verdict ask for all rollouts
            known[record] = self._smooth(model, record)
        return known[record]

    def _smooth(self, model: SensedModel, record: Record) -> tuple[Array, float]:
        steps = len(record.actions)
        if not steps or not np.isfinite(record.states).all():
            return interpolated(record.states[0]), np.inf
        target, weight = self.target[model.seen], self.state_weight * (model.n_z // model.sensors)
        smoothing = Smoothing(
            model.shared, model.actuators, model.noise, target, model.spread, self.settings
        )
        known = distance(record, weight, self.action_weight, self.horizon)
        return smoothing.field(record.acted_from, record.actions, known)


def distance(record: Record, state_weight: float, action_weight: float, horizon: int) -> float:
    """Mean of (z - z_r)^2 from the cost of a rollout; NaN where it has none, as after an exploration.

    state_weight: what a sensor counts.
    """
    if not record.usable or len(record.actions) != horizon:
        return np.nan
    acting = action_weight * float(np.sum(record.actions**2)) / horizon
    found = (record.cost - acting) / (state_weight * record.states.shape[1])
    return found if found > 0.0 else np.nan


def whole_rollouts(
    problem: ClosedLoopProblem, records: Sequence[Record], largest_cost: float, newest: int
) -> list[Record]:
    """The newest whole rollouts, each once, and none whose readings went far away."""
    whole = {
        record.states.tobytes(): record
        for record in records
        if len(record.actions) == problem.horizon and problem.cost_of(record) <= largest_cost
    }
    return list(whole.values())[-newest:]


def of_rollouts(
    problem: ClosedLoopProblem, rollouts: Sequence[Record]
) -> tuple[list[Array], list[Array], Array]:
    """Readings, actions and `distance` of each rollout."""
    weights = problem.state_weight, problem.action_weight, problem.horizon
    return (
        [record.acted_from for record in rollouts],
        [record.actions for record in rollouts],
        np.array([distance(record, *weights) for record in rollouts]),
    )


def fit_rollouts(
    problem: ClosedLoopProblem,
    rollouts: Sequence[Record],
    actuators: Actuators,
    noise: float,
    start: Array | None,
    settings: FieldModelSettings = DEFAULTS,
    spread: Array | None = None,
) -> tuple[Array, Array, float] | None:
    """The fit that reproduces the readings of rollouts, from an earlier equation or from nothing.

    The shared unknowns, the initial fields and the error, as for `fit_sensed`; None if neither does.
    spread: as for `fit_sensed` as well.
    """
    readings, actions, distances = of_rollouts(problem, rollouts)
    for first in (None,) if start is None else (start, None):
        found = fit_sensed(
            readings,
            actions,
            actuators,
            noise,
            start=first,
            target=problem.target,
            distances=distances,
            spread=spread,
            settings=settings,
        )
        if found[2] <= SENSED_REPRODUCED:
            return found
    return None


def can_be_sensed(context: Context) -> bool:
    """True if the states are one reading of each of a few sensors of one component on a ring."""
    sensors, most = context.sensors, SENSED_MOST
    return context.periodic and sensors == len(context.target) and 0 < sensors <= most


def to_be_fitted(
    context: Context, records: Sequence[Record]
) -> tuple[ClosedLoopProblem, list[Record]]:
    """The problem between the sensors, and the rollouts in a fit; the first one is an exploration."""
    problem = ClosedLoopProblem(
        context.U, context.target, context.state_weight, context.action_weight, context.horizon
    )
    settings = context.field_models
    largest_cost = _LARGEST_COST * problem.cost_of(records[0])
    return problem, whole_rollouts(problem, records, largest_cost, settings.sensed_newest)


def sensed_from(
    context: Context, records: Sequence[Record], before: SensedModel | None
) -> tuple[SensedModel, float] | None:
    """The model that reproduces the newest rollouts, and its error; None if it does not.

    before: the model of earlier rollouts, whose equation and spread the fit starts from.
    """
    sensors, n_a, settings = context.sensors, records[0].actions.shape[1], context.field_models
    problem, chosen = to_be_fitted(context, records)
    if not chosen:
        return None
    actuators = context.actuators(n_a)
    start, spread = (None, None) if before is None else (before.shared, before.spread)
    readings, actions, distances = of_rollouts(problem, chosen)
    size = float(np.mean([np.mean(own**2) for own in readings]))
    # Else what the grid does not resolve would be taken for fields and actuators.
    declared = float(np.hypot(context.noise, settings.sensed_unresolved * np.sqrt(size)))
    found = fit_rollouts(problem, chosen, actuators, declared, start, alike(settings), spread)
    noise = context.noise**2 / size
    chance = SENSED_ALIKE_CHI * noise * np.sqrt(2.0 / np.size(readings))
    if found is None or found[2] > max(settings.sensed_unresolved**2, chance):
        near = start if found is None else found[0]
        free = fit_rollouts(problem, chosen, actuators, declared, near, settings, spread)
        if found is None or (free is not None and differ(found[2], free[2], chance, settings)):
            found = free
        else:
            settings = alike(settings)
    else:
        settings = alike(settings)
    if found is None:
        return None
    shared, fields, error = found
    known = list(zip(readings, actions, distances.tolist(), strict=True))

    def learned() -> tuple[Smoothing, Array]:
        # The unpredicted part of a reading is noise to a filter.
        noise = float(np.sqrt(declared**2 + error * size))
        smoothing = Smoothing(shared, actuators, noise, context.target, spread, settings)
        smoothing = smoothing.learned(known, fields)
        assert smoothing.spread is not None
        return smoothing, smoothing.spread

    smoothing, likely = learned()
    # The fit takes noise between the sensors for short waves as long as it knows nothing of them.
    for _ in range(settings.sensed_again):
        if spread is not None and settled(likely, spread):
            break
        again = fit_sensed(
            readings,
            actions,
            actuators,
            declared,
            start=shared,
            target=context.target,
            distances=distances,
            spread=likely,
            settings=settings,
            near=fields,
        )
        if again[2] > SENSED_REPRODUCED:
            break
        (shared, fields, error), spread = again, likely
        smoothing, likely = learned()
    largest = _EXTRAPOLATION * float(np.abs(fields).max())
    model = sensed_model(shared, sensors, actuators, largest, settings, noise=smoothing.noise)
    return replace(model, spread=likely), error


def alike(settings: FieldModelSettings) -> FieldModelSettings:
    """Settings with which a fit holds the strengths of actuators near to each other.

    Few sensors tell little of them: waves that the sensors do not resolve would be taken for
    differences in strength, with which the readings are reproduced as well.
    """
    held = settings.sensed_alike_unequal, settings.sensed_alike_ridge
    return replace(settings, sensed_unequal=held[0], sensed_unequal_ridge=held[1])


def differ(held: float, free: float, chance: float, settings: FieldModelSettings) -> bool:
    """True if actuators differ in strength, by the errors of fits that hold them and do not.

    chance: the least change of an error that noise does not explain.
    """
    return held - free > chance and halved(held, free, settings)


def sensed_loop(context: Context, model: SensedModel) -> SensedLoop:
    """The model under laws with an observer of the readings."""
    assert isinstance(context.law, Observer)
    return SensedLoop(
        model.at_sensors(context.U),
        interpolated(context.target),
        context.state_weight * model.sensors / model.n_z,
        context.action_weight,
        context.horizon,
        context.action_set,
        model=model,
        noise=model.noise,
        law=context.law,
        settings=context.field_models,
    )
