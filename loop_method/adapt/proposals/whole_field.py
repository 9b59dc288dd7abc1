# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law that is improved on a model of the whole field.

Applies where such a model reproduces the last rollouts from beginning to end.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.fit import extended_basis
from loop_method.adapt.proposals.proposal import MODES, TRUST, Proposal, spread
from loop_method.adapt.simulation import Loop, improve
from loop_method.field_models import FieldModel

# Measured initial fields that a law is improved on, the newest.
_FIELDS = 8
# Coordinates of the sensitivities of each component, at least.
_SENSITIVITY_MODES = 48


def propose(
    loop: Loop,
    model: FieldModel,
    error: float,
    data: Sequence[Record],
    policy: Array,
    damping: float,
) -> Proposal:
    """The best law on the model from the measured initial fields.

    error: of the model, in reproducing the rollouts `data`; damping: lambda.
    """
    n_z, n_s = loop.U.shape
    fields = list({record.states[0].tobytes(): record.states[0] for record in data}.values())
    modes = max(MODES, n_s, min(model.components * _SENSITIVITY_MODES, n_z))
    improved = improve(
        loop,
        model,
        loop.theta(policy),
        spread(np.stack(fields[-_FIELDS:])),
        extended_basis(loop.U, [record.states for record in data], modes),
        TRUST * damping,
    )
    candidate = loop.moved(policy, improved.theta - loop.theta(policy))
    return Proposal(candidate, improved.fall, 1, 0.0, error, model.name)
