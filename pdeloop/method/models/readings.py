# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model of few sensors' readings, and its innovations in a rollout.

    x_{k+1} = A x_k + B a_k + G e_k,        U^T y_k = C x_k + e_k

(`pdeloop.method.reduce.subspace`). The unknown initial state x_0 of a measured rollout is its most
likely value. It gives the innovations e_k, with which the model reproduces the readings. Under another
law the model uses the same innovations: the noise, the dynamics beyond the order and, as an
approximation, the nonlinearity.

References
----------
Ljung, "System Identification: Theory for the User", 2nd ed., section 4.3 (innovations form).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models.linear import LinearModel
from pdeloop.method.reduce.reduced_model import Trajectory
from pdeloop.method.reduce.subspace import InnovationModel, likeliest_start, subspace_model

KIND = "innovations"
FOREMOST = 60
"""Steps from whose readings x_0 is estimated, at most: later ones say nothing of it."""


@dataclass(frozen=True, eq=False)
class ReadingsModel(LinearModel):
    """A model in innovation form, as a linear model of its state.

    Attributes
    ----------
    C, G, U : arrays
        As for `InnovationModel`.
    innovations : (r, r) array
        Covariance of e.
    """

    FORM = "readings"
    SHAPES: ClassVar = LinearModel.SHAPES | {
        "C": "r n",
        "G": "n r",
        "U": "y r",
        "innovations": "r r",
    }
    C: Array
    G: Array
    U: Array
    innovations: Array

    def replay(self, readings: Array, actions: Array) -> tuple[Array, Array]:
        """The likeliest x_0 (n,) and the innovations (L, r) of readings and actions (L, ...)."""
        v = readings[: len(actions)] @ self.U
        first = likeliest_start(
            self.A, self.B, self.C, self.G, self.innovations, v[:FOREMOST], actions
        )
        x, e = first, np.empty_like(v)
        for k in range(len(v)):
            e[k] = v[k] - self.C @ x
            x = self.A @ x + self.B @ actions[k] + self.G @ e[k]
        return first, e

    def foreseen(self, first: Array, actions: Array) -> Array:
        """U^T y_k (L, r) from x_0, without innovations."""
        x, found = first, []
        for a in actions:
            found.append(self.C @ x)
            x = self.A @ x + self.B @ a
        return np.array(found)


def fit_readings(
    rollouts: Sequence[Trajectory], target: Array, order: int
) -> tuple[ReadingsModel, float]:
    """The model of rollouts (readings (L + 1, n_y), actions (L, n_a)), and its error E.

    E is that of readings of rollouts that it was not fitted to, foreseen from x_0 without innovations,
    relative to sum |y - y_r|^2. ValueError where the data determine no model.
    """
    whole = subspace_model(rollouts, order=order)
    model = _model(whole)
    missed = size = 0.0
    for fold in range(2):
        others = [rollout for i, rollout in enumerate(rollouts) if i % 2 != fold]
        own = rollouts[fold::2]
        if not others or not own:
            continue
        try:
            half = _model(subspace_model(others, order=order, past=whole.past))
        except ValueError:
            return model, np.inf
        for y, a in own:
            first, _ = half.replay(y, a)
            with np.errstate(all="ignore"):
                wrong = half.foreseen(first, a) @ half.U.T - y[: len(a)]
            missed += float(np.sum(wrong**2))
            size += float(np.sum((y[: len(a)] - target) ** 2))
    return model, missed / size if size > 0.0 and np.isfinite(missed) else np.inf


def _model(found: InnovationModel) -> ReadingsModel:
    none = np.zeros(len(found.A))
    own = found.C, found.G, found.U, found.innovations
    return ReadingsModel(KIND, found.A, found.B, none, *own)
