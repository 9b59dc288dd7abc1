# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Measurement noise that nobody declared, accepted only where a model says so.

Noise cannot be predicted. So unless a model without noise predicts the rollouts better than noise of
the level that their differences allow (`noise_level`) would let it, an equation is fitted for that
noise. The noise is there if this equation predicts rollouts that it was not fitted to better than any
model without noise, and if what it does not predict of the short waves is measurement noise: its
innovations there, along filtered states, have that level and are white in time and space (`is_white`).
Those of a front that is narrower than the grid are not: they gather around it. Long waves are judged by
the prediction, as their innovations hold the equation's own errors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy  # whose transforms, a tenth of a start, load when they are used

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import FieldModel, Measured
from pdeloop.method.models.choice import FittedModel, fit_field_model, limited, with_clean
from pdeloop.method.models.noise_level import is_white, noise_level, share_of_noise, short_waves
from pdeloop.method.models.settings import (
    FAR,
    LEAST_CORRECTION,
    NOISE_MISJUDGED,
    FieldModelSettings,
)
from pdeloop.process.one_thread import one_thread

_NOISE_EXCESS = 1.3
"""Largest root mean square of the innovations of an equation, relative to the noise."""
_WHITE_LEVEL = 0.01
"""Rate at which the test for white innovations rejects independent noise."""
_WHITE_TOLERANCE = 0.5
"""Root sum of squares of the correlations of innovations that counts as white."""

PREDICTED = 0.5
"""E of a model without noise, relative to the share of the noise, below which there is no noise."""
_BEGINNING = 8
"""Innovations of a rollout that are left out, as those of its uncertain initial state."""
_TURNS = 4
"""Times that the filter's shares are computed from its innovations."""


def fit_undeclared_noise(
    rollouts: Sequence[Measured],
    target: Array,
    *,
    settings: FieldModelSettings,
    most: float,
    better_than: float = np.inf,
    declared: float = 0.0,
    action_set: ActionSet = ANY_ACTION,
    weights: Array | None = None,
) -> tuple[FittedModel, float] | None:
    """An equation fitted for measurement noise, and the noise; None where there is no such noise.

    Parameters
    ----------
    rollouts : sequence of Measured
        Of fields of one component on a periodic axis.
    target : (n_z,) array
        z_r.
    settings : FieldModelSettings
        Constants.
    most : float
        Largest error E of the equation.
    better_than : float
        E of the best model without noise.
    declared : float
        Noise that was declared; another one is looked for only if it is `noise_misjudged` times as
        large, or as small.
    action_set : ActionSet
        Admissible actions, the nearest of which is applied.
    weights : array, optional
        As for `fit_field_model`.
    """
    states = [np.asarray(rollout.states) for rollout in rollouts]
    noise = noise_level(states)
    misjudged = max(noise, declared) > NOISE_MISJUDGED * min(noise, declared)
    if (
        not noise
        or not misjudged
        or better_than < PREDICTED * share_of_noise(noise, states, target, weights)
    ):
        return None
    found = fit_field_model(
        rollouts,
        target,
        settings=settings,
        noise=noise,
        action_set=action_set,
        knows_noise=True,
        weights=weights,
    )
    if found is None or found.error > most or not found.error < better_than:
        return None
    known = with_clean([limited(rollout, action_set) for rollout in rollouts], noise)
    with one_thread():
        left = innovations(found.model, known, noise)
    if left is None:
        return None
    short = [short_waves(own) for own in left]
    if not is_white(short, _WHITE_LEVEL, _WHITE_TOLERANCE):
        return None
    size = float(np.sqrt(np.mean(np.concatenate(short) ** 2)))
    return (found, noise) if size <= _NOISE_EXCESS * noise else None


def innovations(
    model: FieldModel, rollouts: Sequence[Measured], noise: float
) -> list[Array] | None:
    """Measured minus predicted states (L, n_z) of each rollout, along its filtered states.

    rollouts: with `clean`, where the filter begins; None where the model runs away.
    """
    power = noise**2 / model.n_z
    shares = np.full(model.n_z // 2 + 1, 0.5)
    for _ in range(_TURNS):
        left = []
        for rollout in rollouts:
            if (own := _along(model, rollout, shares)) is None:
                return None
            left.append(own)
        spectra = np.concatenate([scipy.fft.rfft(own) / model.n_z for own in left])
        error = np.maximum(np.mean(np.abs(spectra) ** 2, axis=0) - power, 0.0)
        shares = np.clip(error / (error + power), LEAST_CORRECTION, 1.0)
    return left


def _along(model: FieldModel, rollout: Measured, shares: Array) -> Array | None:
    """The innovations of one rollout, but for the first; None where the model runs away.

    Until the share that is given is the best one, it is that of an unknown state that rests, 1/(k + 1).
    """
    z, most = rollout.known[:1], FAR * float(np.abs(rollout.states).max())
    left = np.empty((len(rollout.actions), model.n_z))
    for k, action in enumerate(rollout.actions):
        with np.errstate(all="ignore"):
            predicted = model.step(z, action[None])
        if not np.abs(predicted).max() <= most:
            return None
        left[k] = rollout.states[k + 1] - predicted[0]
        own = np.maximum(shares, 1.0 / (k + 2))
        z = predicted + scipy.fft.irfft(own * scipy.fft.rfft(left[k : k + 1]), model.n_z)
    return left[_BEGINNING:]
