# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants of the tests: of any equation, on any grid, and a linear one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pde_sim_node.dynamics import Dynamics
from pde_sim_node.equations import Burgers, Equation
from pde_sim_node.plants import SpectralPlant


def plant_of(equation: Equation, **values: Any) -> SpectralPlant:
    """A plant with both weights 1, and of one internal step a sample, where nothing else is said."""
    values.setdefault("integration_time", values["sample_time"])
    return SpectralPlant(equation, **({"state_weight": 1.0, "action_weight": 1.0} | values))


class Rods(Dynamics):
    """Two rods of three cells that cool and are heated at one end, a cell of them a little unstable."""

    n_z, n_a, horizon, sample_time = 6, 2, 4, 0.05

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.uniform(0.5, 1.5, 6)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        rods = z.reshape(2, 3)
        flow = np.diff(rods, axis=1, prepend=rods[:, :1], append=rods[:, -1:])
        rods = rods + 0.3 * np.diff(flow, axis=1) - 0.02 * rods**3 + 0.01 * rods
        rods[:, 0] += a
        return rods.ravel()


@dataclass(frozen=True, kw_only=True)
class Advection(Burgers):
    """u_t = 0.05 u_xx - 0.7 u_x, as a semilinear equation without its nonlinearity."""

    name = "advection"

    def linear_operator(self, k: np.ndarray) -> np.ndarray:
        return -0.05 * k**2 - 0.7j * k

    def multiplier(self, k: np.ndarray) -> np.ndarray:
        return np.zeros_like(k)
