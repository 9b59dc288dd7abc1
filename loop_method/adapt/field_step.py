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
from loop_method.adapt.initial_fields import initial_fields, is_chaotic, measured_states
from loop_method.adapt.proposal import LEAST_FALL, Proposal
from loop_method.adapt.sensitivity import ISOTROPY
from loop_method.adapt.settings import ModelBasedSettings

SETTINGS = ModelBasedSettings(isotropy=ISOTROPY)
# Trust region of a law that is improved on a model of the field, per lambda; see `improve`.
_MODEL_TRUST_SCALE = 3e-2
# The newest rollouts that such a model is about.
COMPARED = 8
# Further initial fields are this many times as far from the mean of the measured ones.
EXTRAPOLATION = 1.5
# Chaos: the error of a rollout is more than this many times that of its pieces; noise adds up more
# slowly.
_GROWTH, _PIECES = 20.0, 8
# One of three measured states is an initial field, the other two judge.
_HELD_OUT = 3


def field_model(
    context: Context, data: Sequence[Record], first: str, most: float
) -> tuple[Belief | None, bool]:
    """The model of the whole field that predicts the rollouts, and whether it does as a whole.

    first: the kind to try first; most: the largest error E.
    """
    whole = believe(context, data, first)
    if whole is None or whole.error <= most:
        return whole, True
    parts = believe(context, data, first, _PIECES)
    chaotic = parts is not None and parts.error <= min(most, whole.error / _GROWTH)
    return (parts if chaotic else None), False


def propose(
    context: Context,
    belief: Belief,
    whole: bool,
    data: Sequence[Record],
    policy: Array,
    damping: float,
) -> Proposal | None:
    """The best law on the model near to a policy, or None where that gains nothing."""
    loop = belief.loop(context)
    fields, others = initial_fields(data), None
    if whole and not is_chaotic(loop, fields):
        chosen = extrapolated_fields(fields[-COMPARED:])
    else:
        every = measured_states(data, SETTINGS.chaotic_fields * _HELD_OUT)
        held_out = np.arange(len(every)) % _HELD_OUT > 0
        chosen, others = every[~held_out], every[held_out]
    first = loop.theta(policy)
    found = improved(loop, first, chosen, damping)
    if found is None:
        return None
    theta, fall = found
    if others is not None:
        with np.errstate(invalid="ignore"):
            before, after = (loop.costs(law, others).mean() for law in (first, theta))
            fall = before - after
        if not fall > LEAST_FALL * before:  # also where it is not finite
            return None
    kind = belief.model.kind
    return Proposal(loop.policy(theta, policy), fall, 1, 0.0, belief.error, kind, kind, whole)


def improved(
    loop: ClosedLoop, theta: Array, fields: Array, damping: float
) -> tuple[Array, float] | None:
    """The best law on a model near to theta, and by how much its cost is lower."""
    weights = np.full(len(fields), 1.0 / len(fields))
    found = improve(
        *(loop, theta, fields, weights, curvature_of(loop), SETTINGS),
        trust=_MODEL_TRUST_SCALE * damping,
    )
    return None if found is None else (found.theta, found.before - found.after)


def extrapolated_fields(fields: Array) -> Array:
    """The initial fields (F, n_z), and as many that lie further from their mean.

    A law that is best on a few fields is not on their neighbours; on a model, more of them cost no
    rollouts.
    """
    mean = fields.mean(axis=0)
    return np.concatenate([fields, mean + EXTRAPOLATION * (fields - mean)])


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
