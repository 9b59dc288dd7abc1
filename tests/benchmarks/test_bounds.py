# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The bounds in the table of `python -m benchmarks general`: against known optima, and each other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks import bounds
from benchmarks.bounds import best_inputs, inputs_cost, plain_cost, planned_inputs
from benchmarks.families.cases import Case
from benchmarks.families.plants import CoupledPendulums, RandomLinear
from benchmarks.true_model import TrueModel
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plants.loading import as_plant
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.closed_loop import ClosedLoop
from tests.support.small import SMALL

SHORTER = {"horizon": 12, "n_a": 2, "integration_time": 0.01}
"""The small problem with fewer numbers to descend in."""


def loop_on(dynamics: Any, n_s: int, horizon: int, **settings: Any) -> ClosedLoop:
    """The closed loop of laws of the first numbers of the state."""
    plant = as_plant(dynamics)
    cost = plain_cost(plant, horizon)
    return ClosedLoop(np.eye(plant.n_z, n_s), cost, model=TrueModel(plant), **settings)


def test_the_best_inputs_of_a_linear_plant_are_those_of_the_riccati_recursion() -> None:
    plant, T = RandomLinear(), 6
    fields = np.random.default_rng(1).standard_normal((3, plant.n_z))
    P = np.zeros((plant.n_z, plant.n_z))
    for _ in range(T):
        S = plant.action_weight * np.eye(plant.n_a) + plant.B.T @ P @ plant.B
        K = np.linalg.solve(S, plant.B.T @ P @ plant.A)
        P = plant.state_weight * np.eye(plant.n_z) + plant.A.T @ P @ (plant.A - plant.B @ K)
    least = np.einsum("fi,ij,fj->f", fields, P, fields) / T
    loop = loop_on(plant, 4, T)
    law = 0.02 * np.random.default_rng(2).standard_normal((plant.n_a, 5))
    for theta in (np.zeros_like(law), law):  # whatever law they are found around
        np.testing.assert_allclose(best_inputs(loop, theta, fields)[0], least, rtol=1e-3)
        np.testing.assert_allclose(planned_inputs(loop, theta, fields), least, rtol=1e-3)


def test_inputs_have_an_exact_gradient() -> None:
    loop = loop_on(CoupledPendulums(), 6, 7)
    rng = np.random.default_rng(3)
    fields, theta = rng.standard_normal((2, 32)), rng.standard_normal((8, 7))
    v, d = rng.standard_normal((2, 7, 2, 8))
    (up, _), (down, _) = (inputs_cost(loop, theta, v + e * d, fields) for e in (1e-5, -1e-5))
    _, gradient = inputs_cost(loop, theta, v, fields)
    np.testing.assert_allclose(np.sum(gradient * d, axis=(0, 2)), (up - down) / 2e-5, rtol=1e-7)


def test_saturating_inputs_cost_more_and_no_more_than_the_law() -> None:
    free = loop_on(RandomLinear(), 4, 6)
    fields = np.random.default_rng(1).standard_normal((2, 64))
    theta = -0.05 * np.eye(4, 5)
    limited = replace(free, action_set=ActionSet(limit=0.1))
    cost, _ = best_inputs(limited, theta, fields)
    assert (cost > best_inputs(free, theta, fields)[0]).all()
    assert (cost < limited.costs(theta, fields)).all()
    np.testing.assert_allclose(planned_inputs(limited, theta, fields), cost, rtol=1e-3)


class Well(Dynamics):
    """A particle in a valley beside its target, with a hill between them and a wider way round."""

    n_z, n_a, horizon, target, action_weight = 2, 2, 16, np.array([2.0, 0.0]), 0.1

    def initial_state(self, rng: np.random.Generator) -> Array:
        return np.array([0.0, 0.0])

    def step(self, z: Array, a: Array) -> Array:
        return z + 0.2 * a + self._push(z)[0]

    def pull_back(self, z: Array, a: Array, y: Array) -> tuple[Array, Array]:
        return y + np.einsum("...i,...ij->...j", y, self._push(z)[1]), 0.2 * y

    def _push(self, z: Array) -> tuple[Array, Array]:
        """Of the hill at (1, 0), and its derivative."""
        away = z - np.array([1.0, 0.0])
        height = 8.0 * np.exp(-6.0 * np.sum(away**2, axis=-1))[..., None]
        outer = -12.0 * away[..., :, None] * away[..., None, :]
        return height * away, height[..., None] * (np.eye(2) + outer)


def test_several_starts_find_the_way_round_that_a_descent_from_one_misses() -> None:
    """By symmetry no descent from a law without a sideways action leaves the straight line."""
    loop, fields = loop_on(Well(), 2, Well.horizon), np.zeros((1, 2))
    theta = np.array([[-1.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
    straight, around = best_inputs(loop, theta, fields)[0], planned_inputs(loop, theta, fields)
    assert around < 0.5 * straight


def test_limits_and_noise_count() -> None:
    """With them the best law costs more, and noise does not change the limit for known fields."""

    def means(**settings: Any) -> tuple[float, float]:
        case = Case("", str(SMALL), {**SHORTER, **settings}, law_fields=4)
        costs = bounds.bounds_of(case, 0, [1, 2])
        assert (costs["limit"] <= costs["affine"]).all()
        return costs["affine"].mean(), costs["limit"].mean()

    affine, limit = means()
    noisy, same = means(measurement_noise=0.3)
    saturated, higher = means(action_limit=0.05)
    assert noisy > affine and same == pytest.approx(limit, rel=1e-3)
    assert saturated > affine and higher > limit
