# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law for the neighbourhood of a target that no rollout has come near to.

A linear model of rollouts that stay far from the target describes the plant where they are, and laws
that it improves stay there, too. In x = U^T (z - z_r), the samples of all rollouts are fitted by

    x_{k+1} = A x_k + B a_k + H (x_k x x_k)

without a constant, as the target is taken for a steady state. The products account for what changes on
the way to it, so that A and B are those at the target, and a = K x is the LQ law of these two. Where a
rollout of it comes nearer, the next fit knows more of what is there.

References
----------
Peherstorfer, Willcox, "Data-driven operator inference for nonintrusive projection-based model
reduction", CMAME 306, 2016.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Context, Record
from pdeloop.method.design.lqt import track
from pdeloop.method.reduce.reduced_model import ReducedModel

_LINEAR_RIDGE, _PRODUCT_RIDGE = 1e-7, 1e-4
"""Of columns in units of the largest component of x, and of its square."""


def law_about_target(context: Context, records: Sequence[Record]) -> Array | None:
    """[K, -K] of the law above, (n_a, 2 n_s), from measured rollouts and explorations.

    None where the target moves, needs an action or is not of the whole state, the samples are fewer than
    the unknowns, or no law stabilises A.
    """
    cost, W = context.cost, context.weights
    if cost is not None and (cost.target.ndim > 1 or cost.action_target.any()):
        return None
    if W is not None and np.linalg.matrix_rank(np.diag(W) if W.ndim == 1 else W) < len(context.U):
        return None
    U, n_s = context.U, context.U.shape[1]
    pairs = [
        (record.states, min(len(record.actions), len(record.states) - 1)) for record in records
    ]
    x = np.concatenate([(states[:count] - context.target) @ U for states, count in pairs])
    after = np.concatenate(
        [(states[1 : count + 1] - context.target) @ U for states, count in pairs]
    )
    asked = [own.actions[:count] for own, (_, count) in zip(records, pairs, strict=True)]
    a = context.action_set.applied(np.concatenate(asked))
    rows, columns = np.triu_indices(n_s)
    if len(x) < n_s + a.shape[1] + len(rows):
        return None
    unit = float(np.sqrt(np.mean(x**2, axis=0).max())) or 1.0
    x, after = x / unit, after / unit
    features = np.hstack([x, a, x[:, rows] * x[:, columns]])
    ridge = np.full(features.shape[1], _PRODUCT_RIDGE)
    ridge[: n_s + a.shape[1]] = _LINEAR_RIDGE
    gram = features.T @ features / len(x) + np.diag(ridge)
    try:
        found = np.linalg.solve(gram, features.T @ after / len(x))
        model = ReducedModel(found[:n_s].T, unit * found[n_s : n_s + a.shape[1]].T, U)
        q, r = context.state_weight, context.action_weight
        K = track(model, state_weight=q, action_weight=r, cost=cost).K_a
    except (np.linalg.LinAlgError, ValueError):
        return None
    return np.hstack([K, -K]) if np.isfinite(K).all() else None
