# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A first law from a model of the whole field, linearised at the target.

POD modes of an exploratory episode are the directions in which the fields are large, and a law needs
those that it senses: for an unstable plant these differ, as by the end of the episode the field is
saturated. A model of the whole field (`loop_method.field_models`) that reproduces the episode is
linearised at the target, with e = z - z_r,

    e_{k+1} = A e_k + B a_k + d,        d = f(z_r, 0) - z_r,

and the law a = K e + b that minimises the cost over the horizon senses no more than the n_a rows of K.
They come first in U, and POD modes of what is left fill the other columns.

References
----------
Anderson, Moore, "Optimal Control: Linear Quadratic Methods", chapter 4.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg

from loop_interfaces.arrays import Array
from loop_interfaces.model_rows import ModelRows
from loop_method.design.finite_horizon import finite_horizon
from loop_method.field_models import FieldModel
from loop_method.field_models.convolution import fit_convolutions
from loop_method.field_models.differential import fit_differential
from loop_method.reduce.reduced_model import Trajectory, leading_modes, pieces, steps_of

LARGEST = 512
"""Points of a field, at most: the work grows with their third power."""
PIECES, REPRODUCED = 8, 0.05
"""A model reproduces that many pieces of a trajectory, up to this share of sum |z - z_r|^2."""
DEGREE, RIDGE = 3, 1e-5
"""Of the convolution model."""


def reproducing(trajectories: Sequence[Trajectory], target: Array) -> FieldModel | None:
    """The model of the whole field that reproduces pieces of the trajectories best, if well enough.

    Each step counts relative to how much changes in it: saturated fields say little about the plant
    near its target. Pieces, as a chaotic plant forgets where it began.
    """
    data = steps_of(trajectories)
    z, a, after = data.before, data.inputs, data.after
    change = np.sum((after - z) ** 2, axis=1)
    weights = 1.0 / np.maximum(change, 1e-12 * change.max())
    forms = [(DEGREE, 1), (1, 2)] if len(target) % 2 == 0 else [(DEGREE, 1)]
    models: list[FieldModel] = [fit_differential(z, a, after)]
    for degree, components in forms:
        models += fit_convolutions(
            *(z, a, after, weights), degrees=[degree], ridges=[RIDGE], components=components
        )
    size = sum(float(np.sum((states - target) ** 2)) for states, _ in trajectories)
    errors = np.zeros(len(models))
    with np.errstate(over="ignore", invalid="ignore"):
        for i, model in enumerate(models):
            for states, actions in pieces(trajectories, PIECES):
                errors[i] += np.sum((simulated(model, states[0], actions) - states) ** 2)
    best = int(np.argmin(np.nan_to_num(errors, nan=np.inf)))  # a model may overflow
    return models[best] if errors[best] <= REPRODUCED * size else None


def simulated(model: FieldModel, z: Array, actions: Array) -> Array:
    """z_0 .. z_N under given actions."""
    states = [z]
    for a in actions:
        states.append(model.step(states[-1], a))
    return np.array(states)


def field_law(
    trajectories: Sequence[Trajectory],
    target: Array,
    other: ModelRows,
    *,
    state_weight: float,
    action_weight: float,
) -> ModelRows | None:
    """A law from a model of the whole field, with as many modes as another has, if it is better.

    Parameters
    ----------
    trajectories : sequence of (states (N + 1, n_z), actions (N, n_a))
        a_k is held from z_k to z_{k+1}.
    target : (n_z,) array
        z_r.
    other : ModelRows
        The law to compare with.
    state_weight, action_weight : float
        q and r.

    Returns
    -------
    ModelRows or None
        With the linearised model on U. None where no model reproduces the trajectories, or where on the
        one that does the other law costs no more, simulated from their initial fields.
    """
    n_z, n_s = other.U.shape
    model = reproducing(trajectories, target) if n_z <= LARGEST else None
    if model is None:
        return None
    A = model.jacobians(target[None], np.eye(n_z))[0]
    B = model.B
    drift = model.step(target, np.zeros(B.shape[1])) - target
    horizon = max(len(actions) for _, actions in trajectories)
    K, b = finite_horizon(A, B, drift, state_weight, action_weight, horizon)
    sensed = linalg.svd(K, full_matrices=False)[2][:n_s].T
    U = sensed
    if (rest := n_s - sensed.shape[1]) > 0:
        after = steps_of(trajectories).after
        U = np.hstack([sensed, leading_modes(after - after @ sensed @ sensed.T, rest)[0]])
    K_a, s_r = K @ U, U.T @ target
    # Of the K_b with the wanted constant part the least; none where the target is outside of U.
    size = float(s_r @ s_r)
    constant = b - K_a @ s_r
    K_b = np.outer(constant, s_r) / size if size > 0.0 else np.zeros_like(K_a)
    law = ModelRows(A=U.T @ A @ U, B=U.T @ B, U=U, K_a=K_a, K_b=K_b, s_r=s_r)

    def cost(rows: ModelRows) -> float:
        total = 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            for states, actions in trajectories:
                z = states[0]
                for _ in actions:
                    a = rows.K_a @ (z @ rows.U) + rows.K_b @ rows.s_r
                    total += state_weight * np.sum((z - target) ** 2)
                    total += action_weight * np.sum(a**2)
                    z = model.step(z, a)
        return float(total)

    return law if cost(law) < np.nan_to_num(cost(other), nan=np.inf) else None
