# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A step that improves a law on a model of the whole field.

Applies where such a model predicts the rollouts, or, of a chaotic plant, pieces of them. There the law
is improved from many measured states (`initial_fields`), and tried only where it is better from others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Context, Record
from loop_method.adapt.belief import Belief, believe
from loop_method.adapt.closed_loop import ClosedLoop
from loop_method.adapt.improve import curvature_of, improve
from loop_method.adapt.initial_fields import any_state_serves, initial_fields, measured_states
from loop_method.adapt.proposal import Proposal
from loop_method.adapt.settings import GaussNewtonSettings
from loop_method.adapt.undeclared_noise import believe_in_noise

DEFAULTS = GaussNewtonSettings()


def field_model(
    context: Context,
    data: Sequence[Record],
    first: str,
    settings: GaussNewtonSettings = DEFAULTS,
) -> tuple[Belief | None, bool, float]:
    """The model of the whole field that predicts the rollouts, whether it does as a whole, and noise.

    first: the kind to try first. The noise is that for which the model was fitted where another one, or
    none, was declared; 0: as declared. It is looked for before models of pieces, which are short enough
    to be predicted even where noise was taken for the field.
    """
    most = settings.believed_noisy if context.noise else settings.believed
    whole = believe(context, data, first)
    if (found := believe_in_noise(context, data, whole, settings)) is not None:
        return found[0], True, found[1]
    if whole is None or whole.error <= most:
        return whole, True, 0.0
    parts = believe(context, data, first, settings.pieces)
    chaotic = parts is not None and parts.error <= min(most, whole.error / settings.chaotic_growth)
    return (parts if chaotic else None), False, 0.0


def propose(
    context: Context,
    belief: Belief,
    whole: bool,
    data: Sequence[Record],
    policy: Array,
    damping: float,
    settings: GaussNewtonSettings = DEFAULTS,
) -> Proposal | None:
    """The best law on the model near to a policy, or None where that gains nothing."""
    loop = belief.loop(context)
    fields, first = initial_fields(data), loop.theta(policy)
    states = measured_states(data, settings.chaotic_fields)
    if whole and not any_state_serves(loop, first, fields, states):
        chosen = extrapolated_fields(fields[-settings.newest :], settings.extrapolation)
        found = improved(loop, first, chosen, damping, settings)
    else:
        found = improved_from_states(loop, first, data, damping, settings)
    if found is None:
        return None
    theta, fall = found
    kind = belief.model.kind
    return Proposal(loop.policy(theta, policy), fall, 1, 0.0, belief.error, kind, kind, whole)


def improved_from_states(
    loop: ClosedLoop,
    theta: Array,
    data: Sequence[Record],
    damping: float,
    settings: GaussNewtonSettings = DEFAULTS,
) -> tuple[Array, float] | None:
    """As `improved`, of a chaotic plant, from measured states; the fall is that from others.

    More states are taken where a law from few gains nothing from the others, or else the search would
    end for want of a step.
    """
    for count in (settings.chaotic_fields, settings.chaotic_most):
        every = measured_states(data, count * settings.chaotic_share)
        held_out = np.arange(len(every)) % settings.chaotic_share > 0
        found = improved(loop, theta, every[~held_out], damping, settings)
        if found is None:
            return None
        with np.errstate(invalid="ignore"):
            before, after = (loop.costs(law, every[held_out]).mean() for law in (theta, found[0]))
            fall = float(before - after)
        if fall > settings.least_fall * before:  # not where it is not finite
            return found[0], fall
    return None


def improved(
    loop: ClosedLoop,
    theta: Array,
    fields: Array,
    damping: float,
    settings: GaussNewtonSettings = DEFAULTS,
) -> tuple[Array, float] | None:
    """The best law on a model near to theta, and by how much its cost is lower."""
    weights = np.full(len(fields), 1.0 / len(fields))
    found = improve(
        loop,
        theta,
        fields,
        weights,
        curvature_of(loop),
        settings,
        trust=settings.trust * damping,
    )
    return None if found is None else (found.theta, found.before - found.after)


def extrapolated_fields(fields: Array, reach: float) -> Array:
    """The initial fields (F, n_z), and as many that lie `reach` times as far from their mean.

    A law that is best on a few fields is not on their neighbours; on a model, more of them cost no
    rollouts.
    """
    mean = fields.mean(axis=0)
    return np.concatenate([fields, mean + reach * (fields - mean)])


def agrees_with_rejections(
    context: Context, belief: Belief, rejected: Sequence[tuple[Record, Record]]
) -> bool:
    """True if the rejected candidate also costs more than the incumbent on the model.

    rejected: rollouts of the incumbent and of the candidate on the same fields.
    """
    loop = belief.loop(context)
    fields = np.stack([incumbent.states[0] for incumbent, _ in rejected])
    incumbent, candidate = (
        loop.costs(loop.theta(record.policy), fields).mean() for record in rejected[0]
    )
    return bool(candidate > incumbent)
