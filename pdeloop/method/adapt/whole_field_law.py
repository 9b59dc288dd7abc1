# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The best law of the whole field on a model, of which a plant with few sensors has none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.closed_loop import ClosedLoop, Simulation
from pdeloop.method.adapt.improve import curvature_of, improve
from pdeloop.method.adapt.settings import ModelBasedSettings
from pdeloop.method.design.finite_horizon import finite_horizon


@dataclass(frozen=True, eq=False)
class WholeFieldLaw:
    """The best law found of the whole field on a model.

    Attributes
    ----------
    loop : ClosedLoop
        Its U are the modes V.
    theta : (n_a, n_s + 1) array
        [K b].
    simulation : Simulation
        Of this law, from the fields that have a finite cost.
    weights : array
        Of these fields.
    steps : int
        Of L-BFGS.
    """

    loop: ClosedLoop
    theta: Array
    simulation: Simulation
    weights: Array
    steps: int


def whole_field_law(
    loop: ClosedLoop, fields: Array, weights: Array, settings: ModelBasedSettings, modes: int
) -> WholeFieldLaw | None:
    """The best law of so many POD modes; None where none is finite."""
    model, n = loop.model, loop.model.n_z
    none = np.zeros(model.n_a)
    A, B = model.linearise(loop.target, none)
    drift = model.step(loop.target[None], none[None])[0] - loop.target
    K, b = finite_horizon(A, B, drift, loop.state_weight, loop.action_weight, loop.horizon)
    b = b - K @ loop.target

    def under(U: Array) -> ClosedLoop:
        return ClosedLoop(
            U,
            loop.target,
            loop.state_weight,
            loop.action_weight,
            loop.horizon,
            loop.action_set,
            model=loop.model,
        )

    first = under(np.eye(n))
    simulation = first.simulate(np.column_stack([K, b]), fields)
    seen = np.concatenate([fields, simulation.states[1:].reshape(-1, n)])
    rows = linalg.svd(seen, full_matrices=False)[2][:modes]
    whole = under(rows.T)
    found = improve(
        whole, np.column_stack([K @ rows.T, b]), fields, weights, curvature_of(whole), settings
    )
    if found is None:
        return None
    simulation = whole.simulate(found.theta, fields)
    known = np.isfinite(simulation.costs)
    if not known.any():
        return None
    share = weights[known] / weights[known].sum()
    return WholeFieldLaw(whole, found.theta, simulation.of_fields(known), share, found.steps)
