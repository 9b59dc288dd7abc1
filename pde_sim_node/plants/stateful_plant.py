# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant of a stateful `Dynamics`: an object for each environment, whose state cannot be set."""

from __future__ import annotations

from typing import Any

import numpy as np

from pde_sim_node.dynamics import Dynamics, made_again
from pde_sim_node.plant import MEAN_FIELD
from pde_sim_node.plants.dynamics_plant import DynamicsPlant
from pdeloop.messages.arrays import Array
from pdeloop.messages.own_code import OwnCodeError


class StatefulPlant(DynamicsPlant):
    """M objects made with the same arguments, one for each environment, in lock-step.

    The mean field is that of its `mean_state`; the initial state of seed 0 if the class has none, as
    states of simulators cannot be averaged.
    """

    settable = False

    def __init__(self, dynamics: Dynamics, **settings: Any) -> None:
        super().__init__(dynamics, **settings)
        if dynamics.batched:
            raise ValueError(f"{self.name}: a class cannot be both batched and stateful")
        self._objects: list[Dynamics] = []

    def _begun(self, seeds: list[int], environments: list[int]) -> Array:
        while len(self._objects) <= max(environments):
            self._objects.append(made_again(self.dynamics))
        own = zip(seeds, (self._objects[m] for m in environments), strict=True)
        return np.stack([self._start(seed, dynamics) for seed, dynamics in own])

    def _start(self, seed: int, dynamics: Dynamics) -> Array:
        if seed == MEAN_FIELD and type(dynamics).mean_state is not Dynamics.mean_state:
            return self._state("mean_state", self._call("mean_state", of=dynamics))
        generator = np.random.default_rng(0 if seed == MEAN_FIELD else seed)
        return self._state("initial_state", self._call("initial_state", generator, of=dynamics))

    def _next(self, states: Array, actions: Array, environments: Any) -> Array:
        new = []
        for z, a, environment in zip(states, actions, environments.tolist(), strict=True):
            own = self._objects[environment]
            try:
                new.append(self._numbers("step", self._step(z, a, of=own), 1))
            except OwnCodeError:
                self._objects.clear()  # where they stand is unknown
                raise
        return np.concatenate(new)


def plant_of(dynamics: Dynamics, **settings: Any) -> DynamicsPlant:
    """The plant of a user's object; settings: see `DynamicsPlant`."""
    kind = StatefulPlant if dynamics.stateful else DynamicsPlant
    return kind(dynamics, **settings)
