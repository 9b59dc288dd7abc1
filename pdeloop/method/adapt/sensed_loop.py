# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law with an observer on a model of the field between few sensors.

The initial field of a rollout is estimated from its readings
(`pdeloop.method.models.sensed_fit`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Context, Record
from pdeloop.method.adapt.closed_loop import LinearLoop, Simulation
from pdeloop.method.adapt.estimated_loop import simulate_estimated
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.linear import Observer
from pdeloop.method.models.sensed import SensedModel, interpolated, sensed_model
from pdeloop.method.models.sensed_fit import fit_sensed, initial_field
from pdeloop.method.models.settings import (
    DEFAULTS,
    SENSED_MOST,
    SENSED_NEWEST,
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
class SensedLoop(LinearLoop):
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
        known = distance(record, weight, self.action_weight, self.horizon)
        return initial_field(model, record.acted_from, record.actions, target, known, self.settings)


def distance(record: Record, state_weight: float, action_weight: float, horizon: int) -> float:
    """Mean of (z - z_r)^2 from the cost of a rollout; NaN where it has none, as after an exploration.

    state_weight: what a sensor counts.
    """
    if not record.usable or len(record.actions) != horizon:
        return np.nan
    acting = action_weight * float(np.sum(record.actions**2)) / horizon
    found = (record.cost - acting) / (state_weight * record.states.shape[1])
    return found if found > 0.0 else np.nan


def can_be_sensed(context: Context) -> bool:
    """True if the states are one reading of each of a few sensors of one component on a ring.

    And if the cost is that of q and r.
    """
    alone = 0 < context.sensors == len(context.target) <= SENSED_MOST
    return alone and context.periodic and context.cost is None


def to_be_fitted(context: Context, records: Sequence[Record]) -> list[Record]:
    """The newest whole rollouts, each once, and none whose readings went far away.

    The first of the records is an exploration.
    """
    largest_cost = _LARGEST_COST * context.cost_of(records[0])
    whole = {
        record.states.tobytes(): record
        for record in records
        if len(record.actions) == context.horizon and context.cost_of(record) <= largest_cost
    }
    return list(whole.values())[-SENSED_NEWEST:]


def sensed_from(
    context: Context, records: Sequence[Record], before: SensedModel | None
) -> tuple[SensedModel, float] | None:
    """The model that reproduces the newest rollouts, and its error; None if it does not.

    before: the model of earlier rollouts, whose equation and spread the fit starts from.
    """
    chosen = to_be_fitted(context, records)
    if not chosen:
        return None
    weights = context.state_weight, context.action_weight, context.horizon
    actuators = context.actuators(records[0].actions.shape[1])
    found = fit_sensed(
        [record.acted_from for record in chosen],
        [record.actions for record in chosen],
        actuators,
        context.noise,
        start=None if before is None else (before.shared, before.spread),
        target=context.target,
        distances=np.array([distance(record, *weights) for record in chosen]),
        settings=context.field_models,
    )
    if found.error > SENSED_REPRODUCED:
        return None
    model = sensed_model(
        found.shared,
        context.sensors,
        actuators,
        _EXTRAPOLATION * float(np.abs(found.fields).max()),
        context.field_models,
        noise=found.noise,
    )
    return replace(model, spread=found.spread), found.error


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
