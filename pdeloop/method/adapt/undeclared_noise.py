# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The belief in a model that is fitted for measurement noise other than the declared one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdeloop.method.adapt.base import Context, Record
from pdeloop.method.adapt.belief import Belief
from pdeloop.method.adapt.settings import BELIEVED_NOISY, ImprovementSettings
from pdeloop.method.models import Measured
from pdeloop.method.models.undeclared_noise import fit_undeclared_noise


def believe_in_noise(
    context: Context,
    records: Sequence[Record],
    belief: Belief | None,
    settings: ImprovementSettings,
) -> tuple[Belief, float] | None:
    """A model and the noise that it shows, or None to go on with the declared noise.

    belief: with the declared noise.
    """
    if context.sensors or context.shape or not context.line:
        return None
    declared, error = context.noise, np.inf if belief is None else belief.error
    found = fit_undeclared_noise(
        [Measured(record.states, record.actions) for record in records if len(record.actions)],
        context.target,
        settings=context.field_models,
        most=BELIEVED_NOISY,
        # E without another noise is no measure for E with it.
        better_than=np.inf if declared else error,
        declared=declared,
        action_set=context.action_set,
        weights=context.weights,
    )
    return None if found is None else (Belief(found[0].model, found[0].error, 1), found[1])
