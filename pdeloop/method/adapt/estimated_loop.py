# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The law `extended_kalman` on a model of the field between few sensors.

The law of the whole field is designed on the model and acts on the filter's estimate of the field as if
that were the field: certainty equivalence, which is optimal where model and law are linear and the cost
is quadratic. What is not known of the field in a closed loop is seen in simulations under the filter,
of its own model or of others.

References
----------
Bar-Shalom, Tse, "Dual effect, certainty equivalence, and separation in stochastic control", IEEE
Trans. Automatic Control 19(5), 1974.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.closed_loop import ClosedLoop, Simulation
from pdeloop.method.adapt.improve import curvature_of, improve
from pdeloop.method.adapt.settings import ModelBasedSettings
from pdeloop.method.design.lqt import finite_horizon
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.models.sensed import WAVES, SensedFilter, SensedModel, coefficients_of
from pdeloop.method.models.settings import FieldModelSettings

FILTER_MODES = 24
"""Modes of the field that the law extended_kalman feeds back."""
FILTER_INFLATION = 1.0
"""Factor by which the standard deviations of its estimate grow in every step."""
_FILTER_SEEN = 0.2
"""Noise, as a share of the size of a field, for which one of its laws is optimised."""

INDEPENDENT = (0.3, 1.0)
"""Shares of the standard deviation of each wave that initial fields are assumed to have besides the
covariance of those that were estimated; each makes a filter."""
UNPREDICTED = (6.0, 3.0)
"""Multiples of `filter_unpredicted` with which the cheapest law is tried again, one after the other."""


def estimated_laws(
    loop: ClosedLoop,
    law: ExtendedKalman,
    fields: Array,
    weights: Array,
    settings: ModelBasedSettings,
    models: FieldModelSettings,
) -> tuple[list[Array], int]:
    """Theta of laws on the estimate, and the steps of L-BFGS; none if none is finite.

    That of the whole field, and one that is optimised with noise on what it sees, so that it depends
    less on what an estimate has wrong; each with filters that know the initial fields well, and less.
    """
    model = loop.model
    assert isinstance(model, SensedModel)
    whole = whole_field_law(loop, fields, weights, settings, FILTER_MODES)
    if whole is None:
        return [], 0
    size = root_mean_square(model.spread)
    noise = noise_of_filter(model, settings)
    filters = [
        SensedFilter(model, *prior(fields, weights, share), noise, FILTER_INFLATION)
        for share in INDEPENDENT
    ]
    found, theta, steps = [], whole.theta, whole.steps
    for share in (0.0, _FILTER_SEEN):
        seen = replace(whole.loop, noise=share * size)
        if share:
            better = improve(seen, theta, fields, weights, curvature_of(seen), settings)
            if better is None:
                continue
            theta, steps = better.theta, steps + better.steps
        K, b = theta[:, :-1] @ seen.U.T, seen.constant_feature * theta[:, -1]
        found += [law.theta_of(K, b, known, models) for known in filters]
    return found, steps


def noise_of_filter(model: SensedModel, settings: ModelBasedSettings, times: float = 1.0) -> float:
    """Standard deviation of a reading for a filter: noise, and what the model does not predict of it.

    times: multiple of the latter.
    """
    unpredicted = settings.filter_unpredicted * root_mean_square(model.spread)
    return float(np.hypot(model.noise, times * unpredicted))


def least_trusting(
    loop: ClosedLoop, law: ExtendedKalman, best: Array, fields: Array, settings: ModelBasedSettings
) -> Array:
    """The cheapest law with the first of `UNPREDICTED` with which it costs hardly more, or else itself.

    Plants in simulations follow the filter's equation, or ones like it: what trusts it looks too good.

    best: the law on an estimate that is cheapest from these fields.
    """
    model = loop.model
    assert isinstance(model, SensedModel)
    parts, costs = dict(law.parts(best)), loop.costs(best, fields)
    known = np.isfinite(costs)
    if not known.any():
        return best
    most = (1.0 + settings.filter_margin) * costs[known].mean()
    for times in UNPREDICTED:
        noise = noise_of_filter(model, settings, times)
        other = law.vector(parts | {"noise": np.array([noise, FILTER_INFLATION])})
        if loop.costs(other, fields)[known].mean() <= most:
            return other
    return best


def prior(fields: Array, weights: Array, independent: float) -> tuple[Array, Array]:
    """Mean and factor (`SensedFilter`) of the Fourier coefficients of these weighted fields.

    independent: share of the standard deviation of each wave that its cosine and sine have in addition,
    independently, as a few fields do not have all that others may.
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


def simulate_estimated(
    loop: ClosedLoop, law: ExtendedKalman, theta: Array, fields: Array
) -> Simulation:
    """Roll the law's vector theta out from the fields (F, n); the simulation has no features."""
    parts, model = law.parts(theta), loop.model
    assert isinstance(model, SensedModel)
    T, count = loop.horizon, len(fields)
    states, actions = np.zeros((T + 1, *fields.shape)), np.zeros((T, count, model.n_a))
    costs, features = np.full(count, np.inf), np.empty((T, count, 0))
    known = law.filter(parts)
    if known is None:
        return Simulation(states, actions, costs, features)
    costs, finite, a = np.zeros(count), np.ones(count, dtype=bool), loop.action_set.start
    noise = loop.noise * np.random.default_rng(0).standard_normal((T, count, model.sensors))
    states[0] = fields
    x, S = (np.repeat(part[None], count, axis=0) for part in known.start)
    p = np.empty((count, 0))
    with np.errstate(all="ignore"):
        for k in range(T):
            z = states[k]
            y = z[:, model.seen] + noise[k]
            s = y @ law.model.U
            p = p if k else s
            x, S = known.measured(x, S, y)
            before = a
            a = x @ parts["K_e"].T + p @ parts["K"].T + s @ parts["D"].T + parts["b"]
            loop.action_set.project(a, out=a, after=before)
            error = z - loop.target
            costs += loop.state_weight * np.einsum("fi,fi->f", error, error)
            costs += loop.action_weight * np.einsum("fi,fi->f", a, a)
            finite &= np.isfinite(costs)
            for part in (a, x, S, p):
                part[~finite] = 0.0
            p = p @ parts["F"].T + s @ parts["G"].T + a @ law.model.B.T + parts["c"]
            actions[k] = a
            after = model.step(z, a)
            finite &= np.isfinite(after).all(axis=1)
            after[~finite] = 0.0
            states[k + 1] = after
            x, S = known.predicted(x, S, a)
    costs /= T
    costs[~finite] = np.inf
    return Simulation(states, actions, costs, features)


@dataclass(frozen=True, eq=False)
class WholeFieldLaw:
    """The best law found of the whole field on a model.

    Attributes
    ----------
    loop : ClosedLoop
        Its U are the modes V.
    theta : (n_a, n_s + 1) array
        [K b].
    simulation : Simulation
        Of this law, from the fields that have a finite cost.
    weights : array
        Of these fields.
    steps : int
        Of L-BFGS.
    """

    loop: ClosedLoop
    theta: Array
    simulation: Simulation
    weights: Array
    steps: int


def whole_field_law(
    loop: ClosedLoop, fields: Array, weights: Array, settings: ModelBasedSettings, modes: int
) -> WholeFieldLaw | None:
    """The best law of so many POD modes; None where none is finite."""
    model, n = loop.model, loop.model.n_z
    none = np.zeros(model.n_a)
    A, B = model.linearise(loop.target, none)
    drift = model.step(loop.target[None], none[None])[0] - loop.target
    K, b = finite_horizon(A, B, drift, loop.state_weight, loop.action_weight, loop.horizon)
    b = b - K @ loop.target

    def under(U: Array) -> ClosedLoop:
        return ClosedLoop(
            U,
            loop.target,
            loop.state_weight,
            loop.action_weight,
            loop.horizon,
            loop.action_set,
            model=loop.model,
        )

    first = under(np.eye(n))
    simulation = first.simulate(np.column_stack([K, b]), fields)
    seen = np.concatenate([fields, simulation.states[1:].reshape(-1, n)])
    rows = linalg.svd(seen, full_matrices=False)[2][:modes]
    whole = under(rows.T)
    found = improve(
        whole, np.column_stack([K @ rows.T, b]), fields, weights, curvature_of(whole), settings
    )
    if found is None:
        return None
    simulation = whole.simulate(found.theta, fields)
    known = np.isfinite(simulation.costs)
    if not known.any():
        return None
    share = weights[known] / weights[known].sum()
    return WholeFieldLaw(whole, found.theta, simulation.of_fields(known), share, found.steps)
