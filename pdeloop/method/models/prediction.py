# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The errors of a model in predicting measured rollouts from their initial states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import FieldModel, Measured, Samples

_SHORT = 8
"""Steps of a short piece of a beginning, at most."""


def predicted(model: FieldModel, rollouts: Sequence[Measured]) -> list[Array]:
    """z_0 .. z_L of each rollout from its z_0 as it is best known, under its law or else its actions.

    They end before the first state that is not finite.
    """
    z = np.array([rollout.known[0] for rollout in rollouts], dtype=np.float64)
    steps = np.array([len(rollout.actions) for rollout in rollouts])
    alive, found = steps > 0, [[state.copy()] for state in z]
    with np.errstate(all="ignore"):
        for k in range(steps.max(initial=0)):
            rows = np.flatnonzero(alive).tolist()
            a = np.vstack([_action(rollouts[i], k, z[i : i + 1]) for i in rows])
            z[rows] = model.step(z[rows], a)
            finite = np.asarray(np.isfinite(z).all(axis=1))
            for i in rows:
                alive[i] = finite[i] and k + 1 < steps[i]
                if finite[i]:
                    found[i].append(z[i].copy())
            if not alive.any():
                break
    return [np.array(states) for states in found]


def _action(rollout: Measured, k: int, z: Array) -> Array:
    return rollout.actions[k : k + 1] if rollout.law is None else rollout.law(k, z)


def errors(
    model: FieldModel,
    rollouts: Sequence[Measured],
    target: Array,
    worst: float,
    noise: float = 0.0,
    weights: Array | None = None,
    simulated: Sequence[Array] | None = None,
) -> Array:
    """E = sum |W error|^2 / sum |W (z - z_r)|^2 of each rollout, at most `worst`.

    weights: W, a matrix (n, n_z) or its diagonal (n_z,); None: the identity. simulated: what the model
    predicts, if it is known.

    Of a rollout that ends in values that are not finite, those before count; one without two finite
    states is left out. The expected contribution of measurement noise is subtracted from both sums, as
    the model is not to blame for it.
    """
    kept = usable(rollouts)
    simulated = predicted(model, kept) if simulated is None else simulated
    found = np.full(len(kept), float(worst))
    seen = weighing(weights)
    share = noise**2 * (target.size if weights is None else float(np.sum(weights**2)))
    for i, (rollout, states) in enumerate(zip(kept, simulated, strict=True)):
        if len(states) == len(rollout.states):
            with np.errstate(all="ignore"):
                error = float(np.sum(seen(states - rollout.states) ** 2))
                size = float(np.sum(seen(rollout.states - target) ** 2))
                if noise:
                    noisy = share * len(states)
                    error, size = max(error - noisy, 0.0), max(size - noisy, noisy)
                relative = np.divide(error, size)
            found[i] = min(worst, float(np.nan_to_num(relative, nan=worst)))
    return found


def weighing(weights: Array | None) -> Callable[[Array], Array]:
    """x -> W x of rows x (..., n_z); weights: as for `errors`."""
    if weights is None:
        return lambda values: values
    return lambda values: values * weights if weights.ndim == 1 else values @ weights.T


def one_step(model: FieldModel, rollouts: Sequence[Measured], units: Array) -> Array:
    """Sums of squares of the errors of single steps, and of the changes in a step, (2,)."""
    samples = Samples.of(rollouts)
    with np.errstate(all="ignore"):
        missed = samples.after - model.step(samples.before, samples.actions)
        parts = [np.sum((part / units) ** 2) for part in (missed, samples.after - samples.before)]
    return np.nan_to_num(np.array(parts), nan=np.inf)


def usable(rollouts: Sequence[Measured]) -> list[Measured]:
    """The rollouts up to their first value that is not finite, without those of no step."""
    return [short for rollout in rollouts if len((short := finite(rollout)).actions)]


def finite(rollout: Measured) -> Measured:
    """The rollout up to the first value that is not finite, with one state more than actions."""
    states, actions = np.asarray(rollout.states), np.asarray(rollout.actions)
    steps = min(_leading(np.isfinite(actions)), max(_leading(np.isfinite(states)) - 1, 0))
    return rollout.part(0, steps)


def _leading(good: NDArray[np.bool_]) -> int:
    """Rows that are good from the first on."""
    return int(np.argmin(np.append(good.all(axis=1), False)))


def pieces(rollout: Measured, count: int) -> list[Measured]:
    """A rollout cut into at most this many parts of equal length, each with the state at its end."""
    steps = min(len(rollout.actions), len(rollout.states) - 1)
    edges = [steps * part // count for part in range(count + 1)]
    return [rollout.part(begin, end) for begin, end in pairwise(edges) if end > begin]


def beginnings(
    rollouts: Sequence[Measured],
    target: Array,
    limit: float,
    weights: Array | None = None,
    *,
    short: bool = False,
) -> list[Measured]:
    """Each rollout up to where |W (z - z_r)| exceeds `limit` times that of any first state.

    weights: as for `errors`; short: in pieces along which what is unstable hardly grows.
    """
    seen, rollouts = weighing(weights), [own for own in rollouts if len(own.states)]
    with np.errstate(all="ignore"):
        away = [np.linalg.norm(seen(own.states - target), axis=1) for own in rollouts]
    most = limit * max((float(own[0]) for own in away), default=0.0)
    found = []
    for own, sizes in zip(rollouts, away, strict=True):
        end = _leading((sizes <= most)[:, None])
        if end > 1:
            found += pieces(own.part(0, end - 1), -(-(end - 1) // _SHORT) if short else 1)
    return found
