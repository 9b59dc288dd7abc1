# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model of the field between few sensors under laws that estimate it, and the design of such laws.

Laws on the estimate of an extended Kalman filter begin with the best law of the whole field on the
model, a = K x + b with x = V^T z and V the POD modes of simulated fields (`whole_field_law`), and act
on the estimate as if that were the field: certainty equivalence.

References
----------
Bar-Shalom, Tse, "Dual effect, certainty equivalence, and separation in stochastic control", IEEE
Trans. Automatic Control 19(5), 1974.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from weakref import WeakKeyDictionary

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Context, Record
from pdeloop.method.adapt.closed_loop import ClosedLoop, LinearLoop, Simulation
from pdeloop.method.adapt.improve import (
    Improvement,
    ModelBasedSettings,
    curvature_of,
    improve,
)
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.linear import Observer
from pdeloop.method.laws.plans import Act, Planner, simulated
from pdeloop.method.models.base import DEFAULTS, FAR, FieldModelSettings
from pdeloop.method.models.sensed import (
    SENSED_MOST,
    WAVES,
    SensedFilter,
    SensedModel,
    coefficients_of,
    interpolated,
    sensed_model,
)
from pdeloop.method.models.sensed_fit import SENSED_REPRODUCED, fit_sensed, initial_field

SENSED_NEWEST = 8
"""Maximum number of rollouts in a fit, the newest ones."""
_LARGEST_COST = 3.0
"""Maximum cost of a rollout in a fit, per cost of the exploration."""
_EXTRAPOLATION = 1.5
"""Maximum of simulated fields, relative to the estimated initial ones."""
FILTER_MODES = 24
"""Modes of the field that the law extended_kalman feeds back."""
_FILTER_SEEN = 0.2
"""Noise, as a share of the size of a field, for which one of its laws is optimised."""
_INDEPENDENT = 0.3
"""Share of the standard deviation of each wave that initial fields are assumed to have besides the
covariance of those that were estimated."""
UNPREDICTED = (6.0, 3.0)
"""Multiples of `filter_unpredicted` with which the cheapest law is tried again, one after the other."""

_SMOOTHED: WeakKeyDictionary[SensedModel, WeakKeyDictionary[Record, tuple[Array, float]]] = (
    WeakKeyDictionary()
)
"""Initial fields that were found with a model: functions of both alone."""


@dataclass(frozen=True, eq=False)
class SensedLoop(LinearLoop):
    """Laws with an observer on a `SensedModel`; U and target are those of its grid."""

    model: SensedModel = field(kw_only=True)
    settings: FieldModelSettings = DEFAULTS

    @property
    def kalman(self) -> ExtendedKalman:
        """The law, where there are filters."""
        assert isinstance(self.law, ExtendedKalman)
        return self.law

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
        parts, count = self.kalman.parts(theta), len(fields)
        allowed, known, n_a = self.action_set, self.kalman.filter(parts), self.model.n_a
        K, b, features = parts["K_e"], parts["b"], np.empty((self.horizon, count, 0))
        if known is None:
            states, actions = (np.zeros((self.horizon, count, n)) for n in (self.model.n_z, n_a))
            return Simulation(states, actions, np.full(count, np.inf), features)
        plan = Planner(self.model, self.cost, allowed, K, b, around=False, steps=1, terminal=False)
        act = from_estimates(
            lambda x, before, k: allowed.project(x @ K.T + b, after=before), known, self.noise
        )
        costs, states, actions = simulated(plan, fields, act)
        return Simulation(states.swapaxes(0, 1), actions.swapaxes(0, 1), costs, features)

    def of_states(self, U: Array) -> ClosedLoop:
        """The same model under laws a = K U^T z + b of its states."""
        return ClosedLoop(U, self.cost, self.action_set, model=self.model, reach=self.reach)

    def beginnings(self, records: Sequence[Record]) -> Array:
        """The initial field of each rollout, as its readings tell it."""
        return np.stack([self.smoothed(record)[0] for record in records])

    def smoothed(self, record: Record) -> tuple[Array, float]:
        """The initial field of a rollout, and its error."""
        known, model = _SMOOTHED.setdefault(self.model, WeakKeyDictionary()), self.model
        if record in known:  # each renewal and the verdict ask for all rollouts
            return known[record]
        if not len(record.actions) or not np.isfinite(record.states).all():
            return interpolated(record.states[0], model.places), np.inf
        q, r = self.cost.size
        of_cost = distance(record, q * model.n_z / len(model.places), r, self.horizon)
        target = model.observation @ self.target
        given = record.acted_from, record.actions, target, of_cost, self.settings
        known[record] = initial_field(model, *given)
        return known[record]


def distance(record: Record, state_weight: float, action_weight: float, horizon: int) -> float:
    """Mean of (z - z_r)^2 from the cost of a rollout; NaN: unknown; state_weight: of a sensor."""
    if not record.usable or len(record.actions) != horizon:
        return np.nan
    acting = action_weight * float(np.sum(record.actions**2)) / horizon
    found = (record.cost - acting) / (state_weight * record.states.shape[1])
    return found if found > 0.0 else np.nan


def can_be_sensed(context: Context) -> bool:
    """True if states are one reading of each of a few sensors on a ring, and the cost of q and r."""
    alone = 0 < context.sensors == len(context.target) <= SENSED_MOST
    return alone and context.periodic and context.cost is None


def to_be_fitted(context: Context, records: Sequence[Record]) -> list[Record]:
    """The newest whole rollouts, each once, and none whose readings went far away."""
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

    before: that of earlier rollouts, from which the fit starts.
    """
    chosen = to_be_fitted(context, records)
    if not chosen:
        return None
    weights = context.state_weight, context.action_weight, context.horizon
    actuators = context.actuators(records[0].actions.shape[1])
    found = fit_sensed(
        [record.acted_from for record in chosen],
        [record.actions for record in chosen],
        context.places,
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
        context.places,
        actuators,
        _EXTRAPOLATION * float(np.abs(found.fields).max()),
        context.field_models,
        noise=found.noise,
    )
    return replace(model, spread=found.spread), found.error


def sensed_loop(context: Context, model: SensedModel) -> SensedLoop:
    """The model under laws with an observer of the readings."""
    assert isinstance(context.law, Observer)
    target = interpolated(context.target, model.places)
    return SensedLoop(
        model.observation.T @ context.U,
        context.plain(target, context.state_weight * len(model.places) / model.n_z),
        context.action_set,
        model=model,
        noise=model.noise,
        law=context.law,
        reach=FAR * context.largest,
        settings=context.field_models,
    )


def from_estimates(of_fields: Act, known: SensedFilter, sigma: float) -> Act:
    """The same from the estimates of a filter, of readings with noise of this standard deviation."""
    rng, estimate = np.random.default_rng(0), known.start

    def act(z: Array, before: Array, k: int) -> Array:
        nonlocal estimate
        if k == 0:
            first, spread = known.start
            estimate = np.tile(first, (len(z), 1)), np.tile(spread, (len(z), 1, 1))
        else:
            estimate = known.predicted(*estimate, before)
        x, S = estimate
        lost = ~np.isfinite(x).all(axis=1)
        x[lost], S[lost] = 0.0, 0.0
        seen = z @ known.model.observation.T
        x, S = estimate = known.measured(x, S, seen + sigma * rng.standard_normal(seen.shape))
        a = of_fields(x, before, k)
        a[lost] = np.nan
        return a

    return act


def whole_field_law(
    loop: SensedLoop, fields: Array, weights: Array, settings: ModelBasedSettings
) -> tuple[ClosedLoop, Improvement] | None:
    """The best law of the whole field, theta = [K b], on modes that are U of its loop; None: no finite.

    The modes are those of simulations under the linear-quadratic law of the model.
    """
    lqr = loop.regulator
    if lqr is None:
        return None
    every, K, b = loop.of_states(np.eye(loop.model.n_z)), lqr.K, lqr.b
    simulation = every.simulate(np.column_stack([K, b]), fields)
    seen = np.concatenate([fields, simulation.states[1:].reshape(-1, loop.model.n_z)])
    rows = linalg.svd(seen, full_matrices=False)[2][:FILTER_MODES]
    whole, first = loop.of_states(rows.T), np.column_stack([K @ rows.T, b])
    found = improve(whole, first, fields, weights, curvature_of(whole), settings)
    return None if found is None else (whole, found)


def estimated_laws(
    loop: SensedLoop, fields: Array, weights: Array, settings: ModelBasedSettings
) -> tuple[list[Array], int]:
    """Theta of laws on the estimate, and the steps of L-BFGS; none if none is finite.

    That of the whole field, and one that is optimised with noise on what it sees.
    """
    model, best = loop.model, whole_field_law(loop, fields, weights, settings)
    if best is None:
        return [], 0
    whole, law = best
    known = SensedFilter(
        model, *prior(fields, weights, _INDEPENDENT), noise_of_filter(model, settings)
    )
    seen = replace(whole, noise=_FILTER_SEEN * root_mean_square(model.spread))
    found = improve(seen, law.theta, fields, weights, curvature_of(seen), settings)
    every = [law, *([found] if found else [])]
    laws = [
        loop.kalman.theta_of(
            own.theta[:, :-1] @ seen.U.T,
            seen.constant_feature * own.theta[:, -1],
            known,
            loop.settings,
        )
        for own in every
    ]
    return laws, sum(own.steps for own in every)


def noise_of_filter(model: SensedModel, settings: ModelBasedSettings, times: float = 1.0) -> float:
    """Standard deviation of a reading for a filter: noise, and so many times what is not predicted."""
    unpredicted = settings.filter_unpredicted * root_mean_square(model.spread)
    return float(np.hypot(model.noise, times * unpredicted))


def least_trusting(
    loop: SensedLoop, best: Array, fields: Array, settings: ModelBasedSettings
) -> Array:
    """The cheapest law with the first of `UNPREDICTED` with which it costs hardly more, or else itself.

    Simulated plants follow the filter's equation: what trusts it looks too good.
    """
    law, costs = loop.kalman, loop.costs(best, fields)
    known = np.isfinite(costs)
    if not known.any():
        return best
    most = (1.0 + settings.filter_margin) * costs[known].mean()
    for times in UNPREDICTED:
        noise = np.array([noise_of_filter(loop.model, settings, times)])
        other = law.vector({**law.parts(best), "noise": noise})
        if loop.costs(other, fields)[known].mean() <= most:
            return other
    return best


def prior(fields: Array, weights: Array, independent: float) -> tuple[Array, Array]:
    """Mean and factor (`SensedFilter`) of the Fourier coefficients of these weighted fields.

    independent: share of the standard deviation of each wave that its parts have besides.
    """
    x = coefficients_of(fields)
    mean = weights @ x
    off = x - mean
    covariance = off.T @ (weights[:, None] * off)
    own = np.diag(covariance).copy()
    waves = 0.5 * (own[1 : WAVES + 1] + own[WAVES + 1 :])
    added = independent**2 * np.concatenate([own[:1], waves, waves])
    values, vectors = np.linalg.eigh(covariance + np.diag(added))
    return mean, np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def root_mean_square(spread: Array) -> float:
    """That of fields with independent Fourier coefficients of these standard deviations."""
    return float(np.sqrt(spread[0] ** 2 + 2.0 * np.sum(spread[1:] ** 2)))
