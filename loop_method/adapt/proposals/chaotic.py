# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law for a plant that forgets where it began, improved on a model of the whole field.

Applies where a model reproduces the rollouts in pieces, but not from beginning to end, with control or
without.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.fit import extended_basis
from loop_method.adapt.proposals.proposal import LEAST_FALL, MODES, TRUST, Proposal
from loop_method.adapt.simulation import Loop, improve, mismatch
from loop_method.field_models import FieldModel

# Least ratio of the error of a rollout to that of its pieces; noise accumulates more slowly.
_GROWTH = 20.0
# Number of measured states, one in three, from which a law is improved; the others choose it by cost.
_STARTS = 80
_HELD_OUT = 3


def forgets(
    loop: Loop, model: FieldModel, error: float, data: Sequence[Record], reproduced: float
) -> bool:
    """Whether the plant forgets where it began, as a chaotic one does, also under a law.

    Then the model, which has this error on the pieces, does not reproduce what the plant does without
    control, nor every controlled rollout, by far.
    """
    most = max(reproduced, _GROWTH * error)

    def lost(records: Iterable[Record]) -> bool:
        measured = (loop.measured(record) for record in records if record.usable)
        return any(mismatch(loop, model, [own], most) > most for own in measured)

    return lost(r for r in data if not r.policy.any()) and lost(r for r in data if r.policy.any())


def propose(
    loop: Loop,
    model: FieldModel,
    error: float,
    data: Sequence[Record],
    policy: Array,
    damping: float,
) -> Proposal | None:
    """The law that costs least on the model from states it was not improved on.

    Here a cost depends on the initial field as if by chance, and a law that is better from a few of
    them is not from others. So it is improved from many of the measured states, and chosen by its cost
    from others. None if it does not gain from those.
    """
    states = np.concatenate([record.states for record in data])
    chosen = np.linspace(0, len(states) - 1, _STARTS * _HELD_OUT).astype(int)
    held_out = np.arange(len(chosen)) % _HELD_OUT > 0
    modes = max(MODES, loop.U.shape[1])
    path = improve(
        loop,
        model,
        loop.theta(policy),
        states[chosen[~held_out]],
        extended_basis(loop.U, [record.states for record in data], modes),
        TRUST * damping,
    ).path
    costs = [loop.simulate(model, theta, states[chosen[held_out]]).cost for theta in path]
    best = int(np.argmin(np.nan_to_num(costs, nan=np.inf)))
    if not costs[0] - costs[best] > LEAST_FALL * costs[0]:  # also where it is not finite
        return None
    candidate = loop.moved(policy, path[best] - path[0])
    return Proposal(candidate, costs[0] - costs[best], 1, 0.0, error, model.name)
