# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws where no model helps: steps along measured rollouts, and laws about a target never come near to.

With the innovations e_k = z_{k+1} - f(z_k, a_k) of a measured rollout a model f repeats it exactly,

    z_{k+1} = f(z_k, a_k) + e_k        (`ClosedLoop.replays_of`),

so that the model says only how the measured cost of its law changes with the law. That holds near it: a
step is held to it by a trust region, which grows where rollouts on the same initial fields show that it
was good and shrinks where it was not.

A linear model of rollouts that stay far from the target describes the plant where they are, and laws
that it improves stay there, too. In x = U^T (z - z_r), the samples of all rollouts are fitted by

    x_{k+1} = A x_k + B a_k + H (x_k x x_k)

without a constant, as the target is taken for a steady state. The products account for what changes on
the way to it, so that A and B are those at the target, and a = K x is the LQ law of these two.

References
----------
Conn, Gould, Toint, "Trust-Region Methods", SIAM 2000, chapter 6. Peherstorfer, Willcox, CMAME 306, 2016
(operator inference).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Context, Record, by_law, of_law
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.adapt.improve import FIRST_GAIN, ModelBasedSettings, curvature_of, improve
from pdeloop.method.design.lqt import Gains, track
from pdeloop.method.models.base import Measured, samples_of
from pdeloop.method.models.selection import limited
from pdeloop.method.reduce.reduced_model import ReducedModel

ALONG = "steps along measured ones"
"""What the reason of a row of the history ends with where no model helps."""
FEWEST = 2
"""Rollouts of a law with which its mean cost counts."""
FIRST_TRUST = 0.3
"""Weight of the distance from the law that a step begins with, relative to the cost's curvature."""
GROWS, SHRINKS, LARGEST_TRUST = 0.5, 4.0, 1e3
"""Factors of this weight after a step that was better and one that was not, and its bound."""


def best_measured(records: Sequence[Record], first: Array) -> Array:
    """The law with the least mean cost among those of at least `FEWEST` rollouts; else the first."""
    laws = [own for own in by_law(records) if len(own) >= FEWEST]
    means = [float(np.mean([record.cost for record in own])) for own in laws]
    if not np.isfinite(min(means, default=np.inf)):
        return first
    return laws[means.index(min(means))][0].policy


def best_on_same_fields(records: Sequence[Record], first: Array) -> Array:
    """The law that costs least relative to the first one on the fields of both.

    Not one that diverged where the first one did not; where only that diverged, the cheapest.
    """
    base = costs_by_field(records, first)
    best, least, cheapest = first, 0.0, np.inf
    for law in (rolled[0].policy for rolled in by_law(records)):
        own = costs_by_field(records, law)
        common = [seed for seed in own if seed in base]
        if len(common) < FEWEST or np.array_equal(law, first):
            continue
        mine, theirs = (np.array([costs[seed] for seed in common]) for costs in (own, base))
        lost, other = np.isinf(mine), np.isinf(theirs)
        if (lost & ~other).any():
            continue
        both = ~lost & ~other
        saved = float(np.mean(theirs[both] - mine[both])) if both.any() else 0.0
        saved = np.inf if (other & ~lost).any() and saved >= 0.0 else saved
        mean = float(np.mean(mine[~lost])) if (~lost).any() else np.inf
        if saved > least or (saved == least == np.inf and mean < cheapest):
            best, least, cheapest = law, saved, mean
    return best


def costs_by_field(records: Sequence[Record], law: Array) -> dict[int, float]:
    """The costs of the rollouts of a law, by the seeds of their initial fields."""
    own = of_law(records, law)
    return {record.field_seed: record.cost for record in own if record.field_seed >= 0}


def step(
    loop: ClosedLoop, fields: Array, law: Array, settings: ModelBasedSettings, trust: float
) -> tuple[Array, int] | None:
    """The law after a step on replayed rollouts, and its steps of L-BFGS; None if it is not finite."""
    weights = np.full(len(fields), 1.0 / len(fields))
    found = improve(
        loop, loop.theta(law), fields, weights, curvature_of(loop), settings, FIRST_GAIN, trust
    )
    return None if found is None else (loop.policy(found.theta, law), found.steps)


_LINEAR_RIDGE, _PRODUCT_RIDGE = 1e-7, 1e-4
"""Of columns in units of the largest component of x, and of its square."""


def law_about_target(context: Context, records: Sequence[Record]) -> Array | None:
    """[K, -K] of the law above, (n_a, 2 n_s), from all that was measured.

    None where the target moves, needs an action or is not of the whole state, or no law is found.
    """
    cost, W = context.cost, context.weights
    if cost is not None and (cost.target.ndim > 1 or cost.action_target.any()):
        return None
    if W is not None and np.linalg.matrix_rank(np.diag(W) if W.ndim == 1 else W) < len(context.U):
        return None
    K = _tracking(context, records, products=True)
    return None if K is None else np.hstack([K.K_a, -K.K_a])


def designed_again(context: Context, records: Sequence[Record]) -> Array | None:
    """[K_a K_b] of LQ tracking on x' = A x + B a + d, by regression of all that was measured."""
    gains = _tracking(context, records, products=False)
    if gains is None:
        return None
    s_r = context.U.T @ context.target
    return gains.policy_for(s_r) if s_r.any() else gains.policy  # which has no constant part


def _tracking(context: Context, records: Sequence[Record], *, products: bool) -> Gains | None:
    """LQ tracking on A and B of a regression, of x with products, or of s with a constant term d."""
    U, n_s = context.U, context.U.shape[1]
    rollouts = [Measured(record.states, record.actions) for record in records]
    samples = samples_of([limited(rollout, context.action_set) for rollout in rollouts])
    rows, columns = np.triu_indices(n_s)
    a, n = samples.actions, n_s + samples.actions.shape[1]
    origin = context.target if products else 0.0
    x, after = ((states - origin) @ U for states in (samples.before, samples.after))
    unit = float(np.sqrt(np.mean(x**2, axis=0).max())) or 1.0
    x, after = x / unit, after / unit
    more = x[:, rows] * x[:, columns] if products else np.ones((len(x), 1))
    features = np.hstack([x, a, more])
    if len(samples) < features.shape[1]:
        return None
    ridge = np.full(features.shape[1], _PRODUCT_RIDGE if products else 0.0)
    ridge[:n] = _LINEAR_RIDGE
    gram = features.T @ features / len(x) + np.diag(ridge)
    try:
        found = np.linalg.solve(gram, features.T @ after / len(x))
        d = np.zeros(n_s) if products else unit * found[n]
        model = ReducedModel(found[:n_s].T, unit * found[n_s:n].T, U, d=d)
        q, r = context.state_weight, context.action_weight
        gains = track(model, state_weight=q, action_weight=r, cost=context.cost)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return gains if np.isfinite(gains.policy).all() else None
