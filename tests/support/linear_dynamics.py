# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A linear plant of a user's own."""

from __future__ import annotations

from typing import Any

import numpy as np

import pdeloop

A = np.diag([0.5, 0.9, 1.1]) + 0.1 * np.eye(3, k=1)
B = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, -0.5]])


class Linear(pdeloop.Dynamics):
    n_z, n_a, horizon = 3, 2, 4
    state_weight, action_weight, divergence_bound = 2.0, 0.5, 100.0
    target = (1.0, 0.0, -1.0)

    def __init__(self, gain: float = 1.0, *, shape: tuple[int, ...] = (3,)) -> None:
        self.gain, self.shape = gain, shape

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(3)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return A @ z + self.gain * B @ a

    def pull_back(self, z: Any, a: Any, y: Any) -> Any:
        return A.T @ y, self.gain * B.T @ y
