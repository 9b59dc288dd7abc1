# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants of the shipped equations on small grids, and an equation of a user's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pde_sim_node.equations import (
    AllenCahn,
    Burgers,
    ConvectionDiffusionReaction,
    Equation,
    KortewegDeVries,
    Schrodinger,
)
from pde_sim_node.plants import SpectralPlant
from tests.support.plants import plant_of

P1 = {"n_z": 128, "n_a": 6, "width": 0.15, "sample_time": 0.05, "integration_time": 0.0025}
P2 = {"n_z": 256, "n_a": 12, "width": 0.05, "sample_time": 0.01, "integration_time": 0.01}
P3 = {"n_z": 256, "n_a": 10, "width": 0.05, "sample_time": 0.01, "integration_time": 0.001}
P9 = {"n_z": 200, "n_a": 8, "width": 0.1, "sample_time": 0.1, "integration_time": 0.1}
P10 = {"n_z": 256, "n_a": 8, "width": 0.1, "sample_time": 0.001, "integration_time": 0.001}
PROBLEMS = pytest.mark.parametrize(
    ("equation", "grid"),
    [
        (Burgers(), P1),
        (AllenCahn(), P2),
        (KortewegDeVries(), P3),
        (ConvectionDiffusionReaction(), P9),
        (Schrodinger(), P10),
    ],
    ids=["burgers", "allen-cahn", "kdv", "convection-diffusion-reaction", "schrodinger"],
)


def make(equation: Equation, **values: Any) -> SpectralPlant:
    return plant_of(equation, **({"horizon": 50} | values))


def unforced(plant: SpectralPlant, steps: int) -> np.ndarray:
    action = np.zeros((1, plant.n_a))
    plant.reset([-1])
    return np.array([plant.step(action)[0].copy() for _ in range(steps)])


# A user's equation

FISHER = """
from dataclasses import dataclass
import numpy as np
from pde_sim_node.equations import Equation, parameter

STRENGTH = 1.0

@dataclass(frozen=True, kw_only=True)
class Fisher(Equation):
    name = "fisher"
    order = 2.0
    rate: float = parameter(2.0, "growth rate", 0.0, 10.0, "1/time")

    def linear_operator(self, k):
        return self.rate - 0.01 * k**2

    def multiplier(self, k):
        return np.full_like(k, -self.rate)

    @staticmethod
    def nonlinearity(u):
        return STRENGTH * u**2

    def initial_field(self, x, rng):
        return np.full_like(x, 0.1)

    def target(self, x):
        return np.ones_like(x)
"""
FISHER_GRID = {"n_z": 32, "n_a": 1, "width": 0.5, "sample_time": 0.5, "integration_time": 0.01}
