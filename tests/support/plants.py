# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants of the tests: of any equation, on any grid, and a linear one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pde_sim_node.equations import Burgers, Equation
from pde_sim_node.plants import SpectralPlant


def plant_of(equation: Equation, **values: Any) -> SpectralPlant:
    """A plant with both weights 1, and of one internal step a sample, where nothing else is said."""
    values.setdefault("integration_time", values["sample_time"])
    return SpectralPlant(equation, **({"state_weight": 1.0, "action_weight": 1.0} | values))


@dataclass(frozen=True, kw_only=True)
class Advection(Burgers):
    """u_t = 0.05 u_xx - 0.7 u_x, as a semilinear equation without its nonlinearity."""

    name = "advection"

    def linear_operator(self, k: np.ndarray) -> np.ndarray:
        return -0.05 * k**2 - 0.7j * k

    def multiplier(self, k: np.ndarray) -> np.ndarray:
        return np.zeros_like(k)
