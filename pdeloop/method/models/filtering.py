# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Estimates of the states of noisy rollouts from a model and the measurements.

The model predicts the next state, and at every wavenumber k a share g of the innovation, measured minus
predicted, corrects it:

    F[zhat_{k+1}] = F[f(zhat_k, a_k)] + g F[z_{k+1} - f(zhat_k, a_k)].

With white noise of the power R the innovations have the power P + R, where P is that of the error of
the prediction, and g = P/(P + R) minimises the error (the steady-state Kalman filter of independent
wavenumbers). So g is 1 while the model is poor and falls as it improves; the model's error need not be
known beforehand.

References
----------
Anderson, Moore, "Optimal Filtering", chapters 4 and 9.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # whose transforms, a tenth of a start, load when they are used

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import FieldModel, Measured
from pdeloop.method.models.settings import FAR


@dataclass(frozen=True, eq=False)
class Filtered:
    """States of rollouts, (L + 1, n_z) each, and the model's predictions of them.

    power: mean power of the innovations at each wavenumber, of Fourier transforms over the number of
    points; lost: predictions that were not finite, in whose place the last state stood.
    """

    states: list[Array]
    power: Array
    lost: int


def filtered(
    model: FieldModel,
    rollouts: Sequence[Measured],
    first: Sequence[Array],
    shares: Array,
) -> Filtered:
    """The states of rollouts, each with one state more than actions.

    first: their initial states; shares: g, of each wavenumber. A prediction far beyond the measured
    states is rejected.
    """
    n_z, z = model.n_z, np.array(first)
    found = [np.empty(rollout.states.shape) for rollout in rollouts]
    for own, state in zip(found, z, strict=True):
        own[0] = state
    lengths = np.array([len(rollout.actions) for rollout in rollouts])
    total, count, lost = np.zeros(len(shares)), 0, 0
    most = FAR * max(float(np.abs(rollout.states).max()) for rollout in rollouts)
    for k in range(int(lengths.max())):
        rows = np.flatnonzero(lengths > k).tolist()
        actions = np.stack([rollouts[i].actions[k] for i in rows])
        with np.errstate(all="ignore"):
            predicted = model.step(z[rows], actions)
            wrong = ~(np.abs(predicted).max(axis=1) <= most)
        predicted[wrong] = z[rows][wrong]
        innovation = (
            scipy.fft.rfft(np.stack([rollouts[i].states[k + 1] for i in rows]) - predicted) / n_z
        )
        z[rows] = predicted + n_z * scipy.fft.irfft(shares * innovation, n_z)
        for i in rows:
            found[i][k + 1] = z[i]
        total += np.sum(np.abs(innovation) ** 2, axis=0)
        count, lost = count + len(rows), lost + int(wrong.sum())
    return Filtered(found, total / count, lost)
