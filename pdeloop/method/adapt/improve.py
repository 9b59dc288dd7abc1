# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A new law: a descent on a model of the whole field, as far as fields that were left out confirm it.

The descent is L-BFGS on the weighted cost over initial fields, in the coordinates

    x = G^{1/2} theta F^{1/2},        G = R + B^T P B,        F = mean [s; 1][s; 1]^T,

with P of the linear-quadratic problem at the target: of a linear plant the cost has the Hessian 2 I
there, so that few steps suffice and none of them depends on the units of actions and states.

Costs differ far more between fields than between laws, and the saving of a law is proportional to the
cost. So the distance that the law moves is chosen by cross-validation with the cost of the first law as
the control variate: chance is that of the ratio of mean costs.

Fields are drawn from a normal distribution with the mean m of the n measured ones and the covariance

    C = (1 + 1/n) ((1 - rho) S + rho P),        S = 1/(n - 1) sum (z_i - m)(z_i - m)^T,

where P is the mean of S over all shifts along each component of the state: the covariance of a
distribution that looks alike everywhere, of which a few fields tell much. The share rho is nearest to
the true covariance in the mean: with Q the part of a matrix that is not invariant,

    rho = E|Q S - E Q S|^2 / E|Q S|^2.

Draws have this mean and, in as many directions as they can, this covariance exactly.

References
----------
Nocedal, Wright, "Numerical Optimization", 2nd ed., algorithm 7.5 (L-BFGS). Byrd, Lu, Nocedal, Zhu, SIAM
J. Sci. Comput. 16, 1995 (the implementation). Ledoit, Wolf, "A well-conditioned estimator for
large-dimensional covariance matrices", J. Multivariate Analysis 88, 2004. Cochran, "Sampling
Techniques", 3rd ed., Wiley 1977, chapter 6 (ratio estimators).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Record
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.adapt.verdict import ZERO, Estimate, cheapest, mean_change
from pdeloop.method.settings import Settings, setting

FIRST_GAIN = 2e-2
"""`least_gain` before the last renewal."""
_MEMORY = 40
"""Gradient differences that L-BFGS keeps."""
_WINDOW = 5
"""L-BFGS steps that together must reach `least_gain`."""
_ISOTROPY = 1e-3
"""Share of the identity in the second moment of [s; 1] that scales the gains."""
_HALVINGS = 12
"""Maximum number of halvings of a law until the model's fields are finite."""

FAR = 10.0
"""The cost of a law without a finite one, per cost of the law to begin with."""


@dataclass(frozen=True, kw_only=True)
class ModelBasedSettings(Settings):
    """The constants of `model_based`.

    All are dimensionless: costs and gains are scaled by those of the initial law.
    """

    judging: int = setting(3, "rollouts of the final law on fresh fields", 1, 100)
    believed: float = setting(
        0.05,
        "largest E at which a model is used; above it, laws are steps along rollouts",
        0.0,
        1.0,
    )
    mixtures: int = setting(
        24, "most initial fields that are drawn; half as many before the final law", 0, 1000
    )
    most_mixtures: int = setting(
        96, "the same for a final law that fields left out do not confirm", 0, 1000
    )
    iterations: int = setting(100, "maximum number of L-BFGS steps per improvement", 1, 10_000)
    least_gain: float = setting(
        1e-3, "relative gain in a window of steps with which a descent continues", 0.0, 1.0
    )
    confidence: float = setting(
        1.0, "standard errors, if exact, by which a law must beat the first one", 0.0, 10.0
    )
    enough_fields: int = setting(
        48, "number of measured fields at which improvements stop", 2, 1_000_000
    )
    filter_unpredicted: float = setting(
        0.04,
        "share of a field's size that a filter adds to a reading's noise, 1 to 6 times",
        0.0,
        1.0,
    )
    filter_margin: float = setting(
        0.03, "share of the cost that a filter may add by trusting the equation less", 0.0, 1.0
    )


@dataclass(frozen=True, eq=False)
class Improvement:
    """A law, and its weighted cost on the fields where the law to begin with has a finite one.

    steps: of L-BFGS.
    """

    theta: Array
    before: float
    after: float
    steps: int


def improve(
    loop: ClosedLoop,
    theta: Array,
    fields: Array,
    weights: Array,
    curvature: Array,
    settings: ModelBasedSettings,
    least_gain: float | None = None,
    trust: float = 0.0,
) -> Improvement | None:
    """The law after a descent, or None where no law to begin with is finite on the model.

    theta is halved where it is not finite from any field (F, n_z), and single such fields are left out;
    curvature: G; trust: weight of the added cost |x - x_0|^2: for a linear plant the step is
    1/(1 + trust) of the whole one.
    """
    for _ in range(_HALVINGS + 1):
        simulation = loop.simulate(theta, fields)
        finite = np.isfinite(simulation.costs) & (weights > 0.0)
        if finite.any():
            break
        theta = 0.5 * theta
    else:
        return None
    fields, weights = fields[finite], weights[finite] / weights[finite].sum()
    moment = loop.moment(simulation.of_fields(finite), weights)
    count = len(moment) - loop.constants
    size = float(np.trace(moment[:count, :count])) / count
    if not (size > 0.0 and np.isfinite(moment).all()):
        return None
    # s and the constants each in its own unit.
    units = np.append(np.full(count, size), np.full(loop.constants, 1.0 / loop.constants))
    moment[np.diag_indices(len(moment))] += _ISOTROPY * units
    left, right = (_inverse_root(matrix) for matrix in (curvature, moment))
    gain = settings.least_gain if least_gain is None else least_gain
    # Not at the top: a node that never improves a law has no need of it.
    from scipy.optimize import minimize

    before, by_theta = loop.gradient(theta, fields, weights)
    # Of a quadratic cost the step -g/2 leads to its minimum. L-BFGS begins with one of unit length.
    unit = 0.5 * float(np.linalg.norm((left.T @ by_theta @ right).ravel()))
    if not (unit > 0.0 and np.isfinite(unit) and before > 0.0):
        return Improvement(theta, before, before, 0)
    best, values = Improvement(theta, before, before, 0), [1.0]
    least, held = before, trust * unit**2

    def objective(y: Array) -> tuple[float, Array]:
        nonlocal best, least
        at, cost, gradient = theta, before, by_theta  # the descent starts from known values
        if y.any():
            at = theta + left @ (unit * y).reshape(len(left), -1) @ right.T
            cost, gradient = loop.gradient(at, fields, weights)
        if not (cost < FAR * before and np.isfinite(gradient).all()):
            return FAR, np.zeros_like(y)
        total = cost + held * float(y @ y)
        if total < least:
            least, best = total, Improvement(at, before, cost, best.steps)
        slope = unit * (left.T @ gradient @ right).ravel() + 2.0 * held * y
        return total / before, slope / before

    def stop_when_flat(_: Array) -> None:
        values.append(least / before)
        earlier = values[max(len(values) - 1 - _WINDOW, 0)]
        few = len(values) <= _WINDOW
        if not few and earlier - values[-1] <= gain * values[-1]:
            raise StopIteration

    minimize(
        objective,
        np.zeros(theta.size),
        jac=True,
        method="L-BFGS-B",
        callback=stop_when_flat,
        options={"maxiter": settings.iterations, "maxcor": _MEMORY, "ftol": 0.0, "gtol": 0.0},
    )
    return Improvement(best.theta, before, best.after, len(values) - 1)


def _inverse_root(matrix: Array) -> Array:
    """L^{-T} of a matrix L L^T."""
    root = linalg.cholesky(matrix, lower=True)
    inverse: Array = linalg.solve_triangular(root, np.eye(len(root)), lower=True).T
    return inverse


def curvature_of(loop: ClosedLoop) -> Array:
    """R + B^T P B of the model linearised at the target; R where there is none."""
    R, lqr = loop.cost.action_matrix, loop.regulator
    if lqr is not None:
        found = R + lqr.B.T @ lqr.P[:-1, :-1] @ lqr.B
        found = 0.5 * (found + found.T)
        if np.linalg.eigvalsh(found)[0] > 0.0:
            return loop.curvature(found)
    return loop.curvature(R)


CONFIRMED = 0.5
"""Share of the gain on its own fields that a law must reach on those left out; otherwise it is made
again on more drawn fields."""
CHAOTIC_TESTED, CHAOTIC_FIELDS = 32, 96
"""Measured states by which a plant is called chaotic, and those that are its initial fields, for which
no fields are drawn."""
PARTS = 2
"""Parts of the fields, each held out once to choose how far the law moves."""
Draw: TypeAlias = Callable[[Array, int], Array]
"""From measured initial fields, at most so many further ones: `mixtures` with a generator."""
FRACTIONS = 4
"""Equal steps from the first law to the improved one, among which one is chosen."""
_DETUNED = 0.1
"""Share of the gains with which a descent begins again where actuators have rate limits."""
_MEASURED_SHARE = 0.5
"""Weight of the measured fields, where there are drawn ones."""
ALIKE = 1e-2
"""Difference of initial fields, relative to how far states move, up to which they may be one."""
KEPT = 0.99
"""Share of the variance whose directions are drawn from."""
# A field is moved by this share of its distance to another one; without control the costs of a chaotic
# plant then change by more than the other share.
_MOVED, _CHANGED = 1e-2, 4.5e-2
"""For a linear plant and a target of 0 they change by at most 4 _MOVED (Cauchy-Schwarz)."""


@dataclass(frozen=True, eq=False)
class Renewal:
    """A law made on a model: the fraction of the way from the first one to the improved one.

    parts: the laws that each part of the fields did not make; change: of the cost against the first law
    on fields that were left out; steps: of L-BFGS.
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
    draw: Draw,
    settings: ModelBasedSettings,
    *,
    final: bool = True,
) -> Renewal | None:
    """The law of least cost on the model, moved as far as held-out fields confirm; None: not finite.

    improved, parts: the laws after the last descents; fields (n, n_z): measured initial ones, field i
    of part i modulo the number of parts, whatever comes later, so that no law of a part ever sees its
    fields; final: others end sooner, as those of parts do, on fewer fields that are drawn.
    """
    curvature, designed = curvature_of(loop), loop.designed()
    others = [] if designed is None else [designed]

    def descend(
        starts: Sequence[Array], fields: Array, most: int, least_gain: float = FIRST_GAIN
    ) -> Improvement | None:
        """The law after a descent from the cheapest of some laws; most: fields to draw."""
        every, weights = weighted(fields, draw(fields, most))
        start = cheapest(loop, [*starts, *others], every, weights)
        found = improve(loop, start, every, weights, curvature, settings, least_gain)
        if loop.action_set.rated and found:  # actuators follow no large gains
            start = loop.detuned(found.theta, _DETUNED, every, weights)
            again = improve(loop, start, every, weights, curvature, settings, least_gain)
            found = again if again and again.after < found.after else found
        return found

    least_gain = settings.least_gain if final else FIRST_GAIN
    if len(fields) == 1:  # every episode begins with this one: there is nothing to leave out
        only = descend([first, improved], fields, 0, least_gain)
        if only is None:
            return None
        before, after = (float(loop.costs(theta, fields)[0]) for theta in (first, only.theta))
        return Renewal(only.theta, only.theta, [], 1.0, Estimate(after - before), only.steps)

    def from_fields(
        start: Array, starts: Sequence[Array], drawn: int, of_parts: int
    ) -> Renewal | None:
        part_of = np.arange(len(fields)) % len(starts)
        found = [
            descend([first, own], fields[part_of != part], of_parts)
            for part, own in enumerate(starts)
        ]
        best = descend([first, start], fields, drawn, least_gain)
        if best is None:
            return None
        made = [law.theta if law else own for law, own in zip(found, starts, strict=True)]
        steps = best.steps + sum(law.steps for law in found if law)
        i, change = choose_fraction(left_out_costs(loop, first, made, fields), settings.confidence)
        fraction = i / FRACTIONS
        theta = first + fraction * (best.theta - first)
        return Renewal(theta, best.theta, made, fraction, change, steps)

    starts, few = [first] * PARTS, settings.mixtures // 2
    drawn, most = settings.mixtures if final else few, settings.most_mixtures
    found = from_fields(improved, parts or starts, drawn, few)
    if found is None or not final or most <= drawn:
        return found
    gain = own_gain(loop, first, found, fields)
    if not (gain > 0.0 and -found.change.value < CONFIRMED * gain):
        return found
    # A law that is best on too few fields is no start: the descent would stay near it.
    again = from_fields(first, starts, most, most)
    if again is None or not again.change.value < found.change.value:
        return found
    return replace(again, steps=found.steps + again.steps)


def own_gain(loop: ClosedLoop, first: Array, found: Renewal, fields: Array) -> float:
    """By how much the law after the descent is better than the first; 0 where it is hardly better."""
    before, after = loop.costs(first, fields), loop.costs(found.improved, fields)
    known = np.isfinite(before) & np.isfinite(after)
    if not known.any():
        return 0.0
    gain = float(np.sum(before[known] - after[known])) / len(fields)
    return gain if gain > FIRST_GAIN * float(before[known].mean()) else 0.0


def left_out_costs(loop: ClosedLoop, first: Array, parts: Sequence[Array], fields: Array) -> Array:
    """What each fraction of the way costs from each field that was left out, (`FRACTIONS` + 1, n)."""
    shares = np.linspace(0.0, 1.0, FRACTIONS + 1)
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


def initial_fields(records: Sequence[Record]) -> Array:
    """The measured initial fields, (n, n_z), each once, also where noise makes measurements differ."""
    found, seeds = dict[bytes, Array](), set[int]()
    for record in records:
        if record.field_seed < 0 or record.field_seed not in seeds:
            found.setdefault(record.states[0].tobytes(), record.states[0])
        seeds.add(record.field_seed)
    return np.stack(list(found.values()))


def begin_alike(records: Sequence[Record]) -> bool:
    """True if initial fields differ by little of how far states move from them."""
    fields = np.stack([record.states[0] for record in records])
    moved = max(float(np.abs(record.states - record.states[0]).max()) for record in records)
    return bool(np.abs(fields - fields[0]).max() <= ALIKE * moved)


def measured_states(records: Sequence[Record], count: int) -> Array:
    """`count` of the measured states, at equal distances; all where there are fewer."""
    states = np.concatenate([record.states for record in records])
    chosen: Array = states[np.linspace(0, len(states) - 1, min(count, len(states))).astype(int)]
    return chosen


def is_chaotic(loop: ClosedLoop, fields: Array) -> bool:
    """True if small changes grow on a model of the plant, which then counts as chaotic.

    Of half of the fields: a model that runs away from some of them is sensitive near those alone.
    """
    if len(fields) < 2:
        return False
    none = loop.no_control
    still = replace(loop, noise=0.0)
    before = still.costs(none, fields)
    after = still.costs(none, fields + _MOVED * (np.roll(fields, 1, axis=0) - fields))
    known = np.isfinite(before) & np.isfinite(after)
    if not known.any():
        return False
    change = np.abs(after[known] - before[known]) / np.mean(before[known])
    return bool(min(np.mean(change), 2.0 * np.median(change)) > _CHANGED)


def any_state_serves(loop: ClosedLoop, law: Array, fields: Array, states: Array) -> bool:
    """True if measured states may take the place of initial fields: the plant is chaotic.

    One that runs away is as sensitive to where it begins, but diverges under the law from more of the
    late states than of the fields.
    """
    if not is_chaotic(loop, fields):
        return False
    lost = [np.mean(np.isinf(loop.costs(law, each))) for each in (fields, states)]
    return bool(lost[1] <= lost[0])


def mixtures(
    fields: Array,
    most: int,
    rng: np.random.Generator,
    components: int = 1,
    *,
    periodic: bool = True,
) -> Array:
    """Draws (at most `most`, n_z) of the distribution above; none from fewer than two fields.

    components: fields in a state, one after the other; periodic: on a ring, else rho is 0.
    """
    n, n_z = fields.shape
    mean = fields.mean(axis=0)
    deviations = fields - mean
    if n < 2 or most < 2 or not deviations.any():
        return np.empty((0, n_z))
    rho = invariant_share(fields, components) if periodic else 0.0
    covariance = (1.0 - rho) * deviations.T @ deviations / (n - 1)
    if rho > 0.0:
        covariance += rho * averaged_over_shifts(deviations, components) / (n - 1)
    values, vectors = linalg.eigh((1.0 + 1.0 / n) * covariance)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    kept = int(np.searchsorted(np.cumsum(values), KEPT * values.sum())) + 1
    kept = min(kept, n_z)
    count = min(most, 2 * kept + 2)
    draws = rng.standard_normal((count, kept))
    draws -= draws.mean(axis=0)
    if draws.shape[1] < count:
        triangle = linalg.cholesky(draws.T @ draws / count, lower=True)
        draws = linalg.solve_triangular(triangle, draws.T, lower=True).T
    drawn: Array = (
        mean + (draws * np.sqrt(values[: draws.shape[1]])) @ vectors[:, : draws.shape[1]].T
    )
    return drawn


def weighted(fields: Array, drawn: Array) -> tuple[Array, Array]:
    """Measured and drawn fields, and their weights, half of which the measured ones have."""
    share = _MEASURED_SHARE if len(drawn) else 1.0
    own = np.full(len(fields), share / len(fields))
    others = np.full(len(drawn), (1.0 - share) / max(len(drawn), 1))
    return np.concatenate([fields, drawn]), np.concatenate([own, others])


def invariant_share(fields: Array, components: int = 1) -> float:
    """rho of the fields (n, n_z), between 0 and 1; 1 of two fields, which do not tell.

    Examples
    --------
    >>> waves = [np.cos(np.arange(32) * np.pi / 8 + p) for p in np.arange(12) * 0.7]
    >>> invariant_share(np.array(waves)) > 0.8
    True
    >>> bumps = [a * np.exp(-np.arange(32.0)) for a in np.arange(12) + 1.0]
    >>> invariant_share(np.array(bumps)) < 0.2
    True
    """
    n = len(fields)
    deviations = fields - fields.mean(axis=0)
    if n < 3:
        return 1.0
    parts = deviations.reshape(n, components, -1)
    spectra = np.fft.fft(parts, axis=2)
    # <d d^T, e e^T> = (d . e)^2. Of their means over shifts it is that of the cross spectra.
    cross = np.einsum("nax,nbx->nabx", spectra, spectra.conj()) / parts.shape[2]
    invariant = np.einsum("nabx,mabx->nm", cross, cross.conj()).real
    own = (deviations @ deviations.T) ** 2
    products = own - invariant
    total = float(products.sum()) / n
    spread = float(np.trace(products)) - total
    if total <= 1e-12 * float(own.sum()) / n:  # all of it is invariant
        return 0.0
    return float(np.clip(spread / ((n - 1) * total), 0.0, 1.0))


def averaged_over_shifts(deviations: Array, components: int = 1) -> Array:
    """The sum of d d^T of the deviations (n, n_z), averaged over shifts along each component."""
    n, n_z = deviations.shape
    points = n_z // components
    spectra = np.fft.fft(deviations.reshape(n, components, points), axis=2)
    cross = np.einsum("nax,nbx->abx", spectra, spectra.conj())
    rows = np.fft.ifft(cross, axis=2).real / points
    index = np.arange(points)
    shifts = (index[:, None] - index[None, :]) % points
    averaged: Array = rows[:, :, shifts].transpose(0, 2, 1, 3).reshape(n_z, n_z)
    return averaged
