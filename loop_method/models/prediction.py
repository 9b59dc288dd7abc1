# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How well a model predicts measured rollouts from their initial states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.models.base import FieldModel, Measured


def predicted(model: FieldModel, rollout: Measured, steps: int) -> Array:
    """z_0 .. z_steps from the measured z_0, under its law or else its actions.

    They may end in values that are not finite.
    """
    z = np.asarray(rollout.states[:1], dtype=np.float64)
    states = np.full((steps + 1, z.shape[1]), np.inf)
    states[0] = z[0]
    with np.errstate(all="ignore"):
        for k in range(steps):
            a = rollout.law(k, z) if rollout.law else rollout.actions[k : k + 1]
            z = model.step(z, a)
            if not np.isfinite(z).all():
                break
            states[k + 1] = z[0]
    return states


def errors(model: FieldModel, rollouts: Sequence[Measured], target: Array, worst: float) -> Array:
    """E = sum |error|^2 / sum |z - z_r|^2 of each rollout, at most `worst`.

    Of a rollout that ends in values that are not finite, those before count.
    """
    found = []
    for rollout in rollouts:
        measured = np.asarray(rollout.states)
        finite = np.append(np.isfinite(measured).all(axis=1), False)
        steps = min(len(rollout.actions), int(np.argmin(finite)) - 1)
        if steps < 1:
            continue
        measured = measured[: steps + 1]
        with np.errstate(all="ignore"):
            error = np.sum((predicted(model, rollout, steps) - measured) ** 2)
            error = error / np.sum((measured - target) ** 2)
        found.append(min(worst, float(np.nan_to_num(error, nan=worst, posinf=worst))))
    return np.array(found)
