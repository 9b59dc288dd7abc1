# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A damped Gauss-Newton step on the local models that predict best.

Always applies; the other kinds of proposals come before it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.local_model import LocalModel, extended_basis, fit
from loop_method.adapt.loop import Loop
from loop_method.adapt.proposal import LEAST_FALL, MODES, Proposal
from loop_method.adapt.selection import KAPPAS, LOCAL, RIDGES, Comparison, choices, mismatches
from loop_method.adapt.sensitivity import damped_step

# Coordinates that the cubic part of a model acts on, at most.
_CUBIC_MODES = 12
# Weight of a rollout in the fit: falls with its age, down to a floor, and with its cost.
_AGEING = 0.9
_AGEING_FLOOR = 0.3


def propose(
    loop: Loop,
    data: Sequence[Record],
    shares: Sequence[float],
    incumbents: Sequence[Record],
    others: Sequence[Record | None],
    *,
    damping: float,
    accepted: bool,
) -> Proposal | None:
    """The first step that gains enough, else the one that gains most, or None if none is finite.

    Parameters
    ----------
    loop : Loop
        The closed loop and its cost.
    data : sequence of Record
        The rollouts that the models are fitted to.
    shares : sequence of float
        How much each of them counts.
    incumbents, others, damping, accepted
        As of `Proposer.propose`.
    """
    V = extended_basis(loop.U, [record.states for record in data], max(MODES, loop.U.shape[1]))
    models = _fit(data, shares, V, len(incumbents))
    errors = mismatches(models, _comparisons(loop, V, incumbents, others), loop.horizon)
    paths = [loop.path_of(record, V) for record in incumbents if len(record.actions)]
    policy, least = incumbents[0].policy, LEAST_FALL * loop.mean_cost_of(incumbents)
    proposal = None
    for kappa, chosen in choices(errors, accepted):
        step, fall = damped_step(
            [models[i] for i in chosen],
            paths,
            target=V.T @ loop.target,
            state_weight=loop.state_weight,
            action_weight=loop.action_weight,
            gamma=float(np.exp(-kappa / loop.horizon)),
            damping=damping,
        )
        candidate = loop.moved(policy, step)
        if not (np.isfinite(candidate).all() and np.isfinite(fall)):
            continue
        if proposal is None or fall > proposal.fall:
            error = float(errors[chosen, KAPPAS.index(kappa)].min())
            proposal = Proposal(candidate, fall, len(chosen), kappa, error)
        if fall >= least:
            break
    return proposal


def _fit(
    data: Sequence[Record], shares: Sequence[float], V: Array, fields: int
) -> list[LocalModel]:
    """The local models on V; after this many rollouts, a rollout ages by one."""
    newest = max(record.stamp for record in data)
    ages = [(newest - record.stamp) // fields for record in data]
    young = [max(_AGEING**age, _AGEING_FLOOR) for age in ages]
    weights = [own * share for own, share in zip(young, shares, strict=True)]
    x, a, after, weight = steps_of(data, weights, V)
    return fit(x, a, after - x, weight, RIDGES, leading=min(_CUBIC_MODES, V.shape[1]))


def steps_of(
    data: Sequence[Record], weights: Sequence[float], V: Array
) -> tuple[Array, Array, Array, Array]:
    """V^T z, a and V^T z after of all steps, and the weights of their rollouts."""
    parts = []
    for record, weight in zip(data, weights, strict=True):
        x = record.states @ V
        n = min(len(record.actions), len(x) - 1)
        parts.append((x[:n], record.actions[:n], x[1 : n + 1], np.full(n, weight)))
    before, a, after, every = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return before, a, after, every


def _comparisons(
    loop: Loop, V: Array, incumbents: Sequence[Record], others: Sequence[Record | None]
) -> list[Comparison]:
    """Pairs of whole rollouts: two fields, and two policies on one field."""
    chosen = []
    for i, record in enumerate(incumbents):
        neighbour, other = incumbents[(i + 1) % len(incumbents)], others[i]
        if neighbour is not record and neighbour.usable and record.usable:
            chosen.append((record, neighbour))
        if other is not None and record.usable and other.cost < LOCAL * record.cost:
            chosen.append((record, other))
    return [
        Comparison(
            loop.path_of(first, V),
            loop.path_of(second, V),
            loop.theta(second.policy) - loop.theta(first.policy),
        )
        for first, second in chosen
    ]
