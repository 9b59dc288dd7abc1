# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model with a constant term has the poles of the plant, whatever the zero of its data."""

from __future__ import annotations

import numpy as np
import pytest

import pdeloop

A, B = np.array([[0.95, 0.04], [0.03, 0.9]]), np.array([[0.2], [0.0]])


@pytest.mark.parametrize("offset", [0.0, 20.0, 293.15])
def test_a_regulated_plant_in_kelvins_has_the_poles_of_its_deviations(offset: float) -> None:
    """Regulated about a set point, so that hardly anything but the offset tells the constant."""
    rng = np.random.default_rng(3)
    z, states, actions = np.array([1.0, 0.5]), [], []
    for _ in range(600):
        a = 0.5 - 0.4 * (z[:1] - 1.0) + 0.3 * rng.standard_normal(1)
        states.append(z + offset + 0.002 * rng.standard_normal(2))
        actions.append(a)
        z = A @ z + B @ a
    states.append(z + offset)
    model = pdeloop.identify((np.array(states), np.array(actions)), n_s=2)
    found = np.sort(np.linalg.eigvals(model.A).real)
    np.testing.assert_allclose(found, np.sort(np.linalg.eigvals(A).real), atol=0.01)
    rest = np.linalg.solve(np.eye(2) - A, B @ [0.5]) + offset
    s = model.U.T @ rest
    np.testing.assert_allclose(model.A @ s + model.B @ [0.5] + model.d, s, atol=0.01)


def test_gains_of_a_model_in_kelvin_hold_the_target_that_those_of_deviations_do() -> None:
    class Furnace(pdeloop.Dynamics):
        n_z, n_a, horizon, action_weight = 2, 1, 200, 0.1

        def __init__(self, ambient: float) -> None:
            self.ambient, self.target = ambient, ambient + np.array([1.5, 0.5])

        def initial_state(self, rng: np.random.Generator) -> np.ndarray:
            return self.ambient + rng.standard_normal(2)

        def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
            return self.ambient + A @ (z - self.ambient) + B @ a

    costs = []
    for ambient in (0.0, 293.15):
        problem = pdeloop.problem(plant=Furnace(ambient))
        plant = problem.plant()
        model = pdeloop.identify(problem.explore(0), n_s=2)
        gains = pdeloop.track(model, state_weight=1.0, action_weight=0.1)
        law = pdeloop.projected_law(plant, model.U, gains)
        costs.append(pdeloop.rollout(plant, law, [0]).costs.mean[0])
        if ambient:
            with pytest.raises(ValueError, match="needs a target that is not 0"):
                gains.policy_for([0.0, 0.0])
    assert costs[1] == pytest.approx(costs[0], rel=1e-6)
