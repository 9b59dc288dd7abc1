# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A bar that heaters of one side warm, with a fixed and a moving target, as a user brings it."""

from __future__ import annotations

import numpy as np
import pytest

import pdeloop

CELLS = 40


class Bar(pdeloop.Dynamics):
    """Conduction, convection and radiation; three heaters of 0 to 4 kW; one wall is cold."""

    n_z, n_a, horizon, sample_time = CELLS, 3, 120, 5.0
    state_weight, action_weight = 1.0, 0.05
    action_low, action_high = 0.0, 4.0

    def __init__(self, moving: bool = True) -> None:
        dx = 1.0 / CELLS
        self.x = (np.arange(CELLS) + 0.5) * dx
        away = (self.x[:, None] - [0.2, 0.5, 0.8]) / 0.07
        self.heat = 0.6 * np.exp(-0.5 * away**2)
        between = np.eye(CELLS, k=1) + np.eye(CELLS, k=-1)
        between -= np.diag(between.sum(axis=0) + 0.5 * (np.arange(CELLS) == 0))
        self.flow = 4e-4 / dx**2 * between - 0.004 * np.eye(CELLS)
        t = np.arange(self.horizon + 1)[:, None] / self.horizon
        middle = 0.3 + 0.4 * t if moving else np.full((1, 1), 0.5)
        self.target = np.squeeze(10.0 + 8.0 * np.exp(-0.5 * ((self.x - middle) / 0.12) ** 2))

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        offset, bow = 2.0 * rng.standard_normal(2)
        return np.asarray(8.0 + offset + bow * np.cos(np.pi * self.x))

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        for _ in range(10):
            radiated = 1e-5 * ((z + 20.0) ** 3 - 20.0**3)
            z = z + 0.5 * (self.flow @ z + self.heat @ a - radiated)
        return z


def linear_cost(bar: Bar, run: pdeloop.FinishedRun) -> float:
    """LQ tracking by the exact linearisation about the middle of the target and 1 kW, clipped."""
    z, a, small = bar.target if bar.target.ndim == 1 else bar.target[60], np.ones(3), 1e-5
    next_z = bar.step(z, a)
    A = np.stack([(bar.step(z + small * e, a) - next_z) / small for e in np.eye(CELLS)], 1)
    B = np.stack([(bar.step(z, a + small * e) - next_z) / small for e in np.eye(3)], 1)
    plant = pdeloop.problem(plant=bar).plant()
    K, b = pdeloop.track_horizon(A, B, plant.cost, np.eye(CELLS), next_z - A @ z - B @ a)
    own = pdeloop.rollout(plant, lambda k, Z: Z @ K[k].T + b[k], *run.evaluation)
    return float(own.costs.mean.mean())


@pytest.mark.parametrize(("moving", "most"), [(False, 183.0), (True, 247.0)])
@pytest.mark.filterwarnings("ignore::pdeloop.TrainingWarning")
def test_it_is_as_near_as_tracking_that_knows_the_bar(moving: bool, most: float) -> None:
    bar = Bar(moving)
    run = pdeloop.train(plant=bar, rollouts=6)
    cost = float(run.costs["adapted"].mean())
    assert cost < most and cost < 1.05 * linear_cost(bar, run)
    assert float(run.costs["none"].mean()) > 5000.0
