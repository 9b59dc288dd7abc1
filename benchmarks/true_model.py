# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant itself as a model of the field, for laws that are improved on an exact model."""

from __future__ import annotations

from typing import Any

import numpy as np

from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plant import Plant
from pde_sim_node.plants.dynamics_plant import DynamicsPlant
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import linearised

__all__ = ["TrueModel"]


class TrueModel:
    """A plant that has exact derivatives as a `pdeloop.method.models.FieldModel`.

    The steps and derivatives of a `Dynamics` must take batches.
    """

    kind = "true"

    def __init__(self, plant: Plant) -> None:
        self.n_z, self.n_a = plant.n_z, plant.n_a
        self._plant = plant
        # As a plant it takes one state after the other, so that their number changes no bit.
        self._dynamics: Dynamics | None = None
        if isinstance(plant, DynamicsPlant):
            self._dynamics = plant.dynamics
        self._adjoint = plant.adjoint()

    def step(self, states: Array, actions: Array) -> Array:
        if self._dynamics is None:
            return self._plant.evaluate(states, actions)[0]
        with np.errstate(all="ignore"):
            return self._dynamics.step(states, actions)

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        if self._dynamics is None:
            return self._adjoint.pull_back(states, actions, covectors)
        return self._dynamics.pull_back(states, actions, covectors)

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        return linearised(self, state, action)

    def arrays(self) -> dict[str, Any]:
        return {}
